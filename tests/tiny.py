"""A tiny training run as TOML, for every test that trains."""

MODEL = """
[model.canonical]
width = 22
height = 16
[model.network]
channels = [4, 8]
features = 16
hidden = 16
"""


def toml(*, model: str = MODEL, sequences: int = 2, **recipe: float) -> str:
    """The configuration `tiny`: a run of 8 updates on sequences of half a second.

    Args:
        model: its tables of the model; empty for the default model.
        sequences: number of simulated sequences.
        recipe: fields of the recipe that differ.
    """
    fields = {"steps": 8, "batch": 2, "segment_windows": 4, "chunk_windows": 2} | recipe
    lines = "\n".join(f"{name} = {value}" for name, value in fields.items())
    data = f'[data]\nsequences = {sequences}\nseconds = 0.5\n[data.cameras]\n"pinhole:24x18" = 1.0\n'
    return f'name = "tiny"\n{model}{data}[recipe]\n{lines}\n'
