"""`linemap verify`: the paper, checked equation by equation."""

import dataclasses
import json
import shutil
import sys

from linemap_jax.cli.compilations import keep_compilations


@dataclasses.dataclass(frozen=True, kw_only=True)
class Verify:
    """Check the paper, equation by equation: derivatives by hand and by autodiff, and where the print is wrong."""

    json: bool = False
    """Print the table, with every single check, as JSON."""

    def run(self) -> int:
        """Check the paper, and give the exit status: 1 if a check fails."""
        keep_compilations()
        from linemap_jax.lab.verification import as_dict, as_text, verify

        print("linemap: compiles for half a minute, the first time", file=sys.stderr)
        rows = verify()
        if self.json:
            print(json.dumps([as_dict(row) for row in rows], indent=2))
        else:
            print(as_text(rows, width=min(shutil.get_terminal_size().columns, 120)))
        return 0 if all(row.passed for row in rows) else 1
