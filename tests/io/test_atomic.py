"""Files are there in full or not at all."""

import os
import stat
from pathlib import Path

import pytest

from linemap_jax.io.atomic import OutputError, atomic_write


def names(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


def test_moves_what_was_written(tmp_path: Path) -> None:
    target = tmp_path / "map.json"
    with atomic_write(target, overwrite=False) as temporary:
        assert temporary.parent == tmp_path
        assert temporary.suffix == ".json"
        assert not target.exists()
        temporary.write_text("new")
    assert target.read_text() == "new"
    assert names(tmp_path) == ["map.json"]


def test_a_new_file_has_the_mode_of_any_new_file(tmp_path: Path) -> None:
    with atomic_write(tmp_path / "a", overwrite=False):
        pass
    (tmp_path / "b").touch()
    assert (tmp_path / "a").stat().st_mode == (tmp_path / "b").stat().st_mode


def test_refuses_an_older_file_before_any_work(tmp_path: Path) -> None:
    target = tmp_path / "map.json"
    target.write_text("old")
    with pytest.raises(OutputError, match=r"map\.json exists already; use --overwrite"):
        with atomic_write(target, overwrite=False):
            pytest.fail("the block must not run")
    assert target.read_text() == "old"
    assert names(tmp_path) == ["map.json"]


def test_refuses_a_file_that_appeared_meanwhile(tmp_path: Path) -> None:
    target = tmp_path / "map.json"

    def write_late() -> None:
        with atomic_write(target, overwrite=False) as temporary:
            temporary.write_text("new")
            target.write_text("somebody else's")

    with pytest.raises(OutputError, match="exists already"):
        write_late()
    assert target.read_text() == "somebody else's"
    assert names(tmp_path) == ["map.json"]


def test_replaces_an_older_file_and_keeps_its_mode(tmp_path: Path) -> None:
    target = tmp_path / "map.json"
    target.write_text("old")
    target.chmod(0o640)
    with atomic_write(target, overwrite=True) as temporary:
        temporary.write_text("new")
        assert target.read_text() == "old"
    assert target.read_text() == "new"
    assert stat.S_IMODE(target.stat().st_mode) == 0o640


def test_follows_a_link(tmp_path: Path) -> None:
    target, link = tmp_path / "map.json", tmp_path / "latest.json"
    target.write_text("old")
    link.symlink_to(target)
    with atomic_write(link, overwrite=True) as temporary:
        temporary.write_text("new")
    assert link.is_symlink()
    assert target.read_text() == "new"


@pytest.mark.parametrize("error", [KeyboardInterrupt, ValueError, SystemExit])
def test_leaves_nothing_behind_when_interrupted(tmp_path: Path, error: type[BaseException]) -> None:
    target = tmp_path / "map.json"
    target.write_text("old")

    def write_half() -> None:
        with atomic_write(target, overwrite=True) as temporary:
            temporary.write_text("half")
            raise error

    with pytest.raises(error):
        write_half()
    assert target.read_text() == "old"
    assert names(tmp_path) == ["map.json"]


def test_says_that_the_disk_is_full(tmp_path: Path) -> None:
    with pytest.raises(OutputError, match=r"^cannot write .*map\.json: No space left on device$"):
        with atomic_write(tmp_path / "map.json", overwrite=False):
            raise OSError(28, "No space left on device")
    assert names(tmp_path) == []


def test_says_that_the_folder_is_missing(tmp_path: Path) -> None:
    with pytest.raises(OutputError, match=r"cannot write .*map\.json: the folder .*nowhere does not exist"):
        with atomic_write(tmp_path / "nowhere" / "map.json", overwrite=False):
            pytest.fail("the block must not run")


def test_says_that_the_folder_is_a_file(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    with pytest.raises(OutputError, match=r"cannot write .*map\.json: Not a directory"):
        with atomic_write(tmp_path / "file" / "map.json", overwrite=False):
            pytest.fail("the block must not run")


def test_says_that_the_folder_cannot_be_written_to(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def deny(*_: object) -> int:
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr(os, "open", deny)  # the administrator may write anywhere, so a mode would not do
    with pytest.raises(OutputError, match=r"cannot write .*map\.json: Permission denied"):
        with atomic_write(tmp_path / "map.json", overwrite=False):
            pytest.fail("the block must not run")


def test_never_replaces_a_folder_or_a_device(tmp_path: Path) -> None:
    for target in (tmp_path, Path(os.devnull)):
        with pytest.raises(OutputError, match="not a regular file"):
            with atomic_write(target, overwrite=True):
                pytest.fail("the block must not run")
    assert not Path(os.devnull).is_file()
