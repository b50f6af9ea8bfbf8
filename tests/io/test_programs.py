"""Programs kept on the disk: the same results, traced once, and made anew where the file is of no use."""

from pathlib import Path

import jax
import numpy as np
import pytest

from linemap_jax import Capacity, LineMap, Thresholds, empty_map
from linemap_jax.io import programs
from linemap_jax.io.programs import kept_program

traced = []


def grow(line_map: LineMap, thresholds: Thresholds, *, times: int) -> LineMap:
    """Something with maps, a traced number and a static one, that tells when it is traced."""
    traced.append(times)
    return jax.tree.map(lambda x: x * 2 if x.dtype == np.float32 else x, line_map)


def kept(folder: Path):
    """As a new process has it: jax knows of nothing that was traced before."""
    jax.clear_caches()
    return kept_program(grow, folder, static_argnames=["times"])


@pytest.fixture(autouse=True)
def nothing_traced():
    traced.clear()


@pytest.fixture
def line_map() -> LineMap:
    return empty_map(Capacity(4, 2))


def test_it_computes_what_the_function_computes(tmp_path, line_map):
    made = kept(tmp_path)(line_map, thresholds=Thresholds(), times=1)
    read = kept(tmp_path)(line_map, thresholds=Thresholds(), times=1)
    told = grow(line_map, Thresholds(), times=1)
    for found in (made, read):
        assert isinstance(found, LineMap)
        jax.tree.map(np.testing.assert_array_equal, found, told)


def test_it_is_traced_once(tmp_path, line_map):
    for _ in range(3):
        kept(tmp_path)(line_map, thresholds=Thresholds(gap_distance=0.2), times=1)
    assert traced == [1]
    assert len(list(tmp_path.glob("*.program"))) == 1


def test_another_static_option_or_shape_is_another_program(tmp_path, line_map):
    call = kept(tmp_path)
    call(line_map, thresholds=Thresholds(), times=1)
    call(line_map, thresholds=Thresholds(), times=2)
    call(empty_map(Capacity(8, 2)), thresholds=Thresholds(), times=2)
    call(line_map, thresholds=Thresholds(gap_distance=jax.numpy.float32(0.2)), times=2)  # no longer weakly typed
    assert traced == [1, 2, 2, 2]


def test_other_source_is_another_program(tmp_path, line_map, monkeypatch):
    kept(tmp_path)(line_map, thresholds=Thresholds(), times=1)
    monkeypatch.setattr(programs, "_source", lambda: "edited")
    kept(tmp_path)(line_map, thresholds=Thresholds(), times=1)
    assert traced == [1, 1]


@pytest.mark.parametrize("damage", [lambda b: b[:100], lambda b: b"", lambda b: b[:-1] + bytes([b[-1] ^ 1])])
def test_a_damaged_file_is_made_anew(tmp_path, line_map, damage):
    kept(tmp_path)(line_map, thresholds=Thresholds(), times=1)
    [file] = tmp_path.glob("*.program")
    whole = file.read_bytes()
    file.write_bytes(damage(whole))
    kept(tmp_path)(line_map, thresholds=Thresholds(), times=1)
    assert traced == [1, 1]
    kept(tmp_path)(line_map, thresholds=Thresholds(), times=1)
    assert traced == [1, 1]


def test_a_folder_that_cannot_be_made_is_done_without(tmp_path, line_map):
    (tmp_path / "file").write_text("in the way")
    found = kept(tmp_path / "file" / "programs")(line_map, thresholds=Thresholds(), times=1)
    jax.tree.map(np.testing.assert_array_equal, found, grow(line_map, Thresholds(), times=1))


def test_old_programs_make_room(tmp_path, line_map, monkeypatch):
    monkeypatch.setattr(programs, "MOST_KEPT", 2)
    call = kept(tmp_path)
    for times in range(4):
        call(line_map, thresholds=Thresholds(), times=times)
    assert len(list(tmp_path.glob("*.program"))) == 2
