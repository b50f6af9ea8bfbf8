"""The parts of README that the scripts beside this file write."""

from pathlib import Path

README = Path(__file__).resolve().parents[1] / "README.md"


def write_part(name: str, text: str) -> None:
    """Put a text between the markers `<!-- name:begin -->` and `<!-- name:end -->`, in place of what stands there."""
    begin, end = f"<!-- {name}:begin -->", f"<!-- {name}:end -->"
    before, rest = README.read_text(encoding="utf-8").split(begin)
    _, after = rest.split(end)
    README.write_text(f"{before}{begin}\n{text}\n{end}{after}", encoding="utf-8")
