"""Output files that are either there in full or not there at all."""

import contextlib
import os
import secrets
import shutil
from collections.abc import Iterator
from pathlib import Path


class OutputError(OSError):
    """A file could not be written. The message is one sentence that names the file and the cause."""


@contextlib.contextmanager
def atomic_write(path: str | os.PathLike[str], *, overwrite: bool) -> Iterator[Path]:
    """Give a temporary path to write to, and move it to `path` when the block ends well.

    The temporary file lies in the same folder, has the same suffix, and is removed when the block is left by an error
    or an interrupt; an older file at `path` is then as it was. A link is followed, and the mode of an older file kept.

    Args:
      path: where the file shall be.
      overwrite: whether an older file may be replaced.

    Yields:
      The temporary path; an empty file is there already.

    Raises:
      OutputError: if there is a file already and `overwrite` is false, if the folder is missing or cannot be written
        to, or if the block raises an `OSError` (such as a full disk).
    """
    target = Path(os.path.realpath(path))
    temporary = target.with_name(f".linemap-{secrets.token_hex(6)}{target.suffix}")
    try:
        _refuse(path, target, overwrite)
        # Not `tempfile`, whose files only their owner can read.
        os.close(os.open(temporary, os.O_CREAT | os.O_EXCL | os.O_WRONLY, 0o666))
        yield temporary
        _refuse(path, target, overwrite)  # the block may have taken long
        if target.exists():
            shutil.copymode(target, temporary)
        os.replace(temporary, target)
    except OutputError:
        raise
    except FileNotFoundError as error:
        missing = not target.parent.exists()
        cause = f"the folder {target.parent} does not exist" if missing else error.strerror
        raise OutputError(f"cannot write {os.fspath(path)}: {cause}") from error
    except OSError as error:
        raise OutputError(f"cannot write {os.fspath(path)}: {error.strerror or error}") from error
    finally:
        with contextlib.suppress(OSError):  # gone after the move; or its folder was never there
            temporary.unlink()


def _refuse(path: str | os.PathLike[str], target: Path, overwrite: bool) -> None:
    """Raise if `target` may not be written: a folder, a device, or a file that nobody allowed to replace."""
    if not target.exists():
        return
    if not target.is_file():
        raise OutputError(f"cannot write {os.fspath(path)}: it is not a regular file")
    if not overwrite:
        raise OutputError(f"{os.fspath(path)} exists already; use --overwrite to replace it")
