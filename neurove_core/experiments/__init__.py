"""The paper's experiments, each reproduced by one command: `neurove reproduce`. Nothing else imports them."""

from pathlib import Path

from neurove_core.figures import unwritable


def save_text(text: str, file: Path) -> Path:
    """Write a text file, with the folders above it; returns its path.

    Raises:
        InvalidField: the file cannot be written.
    """
    try:
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text(text)
    except OSError as error:
        raise unwritable(file, error) from None
    return file
