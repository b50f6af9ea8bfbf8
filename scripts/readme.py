"""The parts of README that the scripts beside this file write."""

from pathlib import Path

README = Path(__file__).resolve().parents[1] / "README.md"


def read_part(name: str) -> str:
    """What stands between the markers `<!-- name:begin -->` and `<!-- name:end -->`."""
    return _divided(name)[1]


def write_part(name: str, text: str) -> None:
    """Put a text between those markers, in place of what stands there."""
    before, _, after = _divided(name)
    README.write_text(f"{before}\n{text}\n{after}", encoding="utf-8")


def _divided(name: str) -> tuple[str, str, str]:
    """README up to the one marker, between the two, and from the other one on."""
    readme = README.read_text(encoding="utf-8")
    begin, end = (f"<!-- {name}:{edge} -->" for edge in ("begin", "end"))
    start, stop = readme.index(begin) + len(begin), readme.index(end)
    return readme[:start], readme[start:stop], readme[stop:]
