"""What the commands leave behind: the places of their files, and what they say on the side."""

import os
import sys
from pathlib import Path


def check_output(folder: Path, *files: Path, overwrite: bool) -> None:
    """Refuse before the work what would be refused after it. Nothing is made yet: the log may be refused too."""
    from linemap_jax.io.atomic import OutputError

    try:
        for file in files:
            if file.exists() and not overwrite:
                raise OutputError(f"{file} exists already; use --overwrite to replace it")
        lowest = next(path for path in (folder, *folder.absolute().parents) if path.exists())
    except PermissionError as error:
        raise OutputError(f"cannot write to the folder {folder}: {error.strerror}") from error
    if not lowest.is_dir():
        raise OutputError(f"cannot write to {folder}: {lowest} is not a folder")
    if not os.access(lowest, os.W_OK | os.X_OK):
        raise OutputError(f"cannot write to the folder {lowest}: permission denied")


def make_folder(folder: Path) -> None:
    """Make the folder and those above it, where they are not there yet."""
    from linemap_jax.io.atomic import OutputError

    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise OutputError(f"cannot make the folder {folder}: {error.strerror}") from error


def say(sentence: str, *, quiet: bool) -> None:
    """Tell people, on stderr; results go to stdout."""
    if not quiet:
        print(f"linemap: {sentence}", file=sys.stderr)
