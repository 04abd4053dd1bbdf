"""The paper's experiments. `neurove reproduce` runs each with one command; no other package imports them."""

from pathlib import Path

from neurove_core.figures import unwritable
from neurove_core.files import write_atomically


def save_text(text: str, file: Path) -> Path:
    """Write a text file, create the folders above it, and return its path.

    Raises:
        InvalidField: the file cannot be written.
    """
    try:
        file.parent.mkdir(parents=True, exist_ok=True)
        write_atomically(file, text.encode())
    except OSError as error:
        raise unwritable(file, error) from None
    return file
