"""The paper's mathematics, equation by equation: derivatives by hand and by autodiff, and where the print is wrong.

The modules in their order:

  literals        the paper's formulas in plain NumPy, and their derivatives as derived by hand
  cases           inputs on which formulas for lines break
  derivatives     what holds the derivatives against one another
  sample          walls seen in one scan, through the pipeline
  equations       a row for each equation: `verify`
  tables          the rows as tables, and which parts of `core` cite which equation
"""

from linemap_jax.lab.verification.derivatives import DERIVATIVES, Agreement, Derivative, check_derivatives
from linemap_jax.lab.verification.equations import Check, Row, verify
from linemap_jax.lab.verification.tables import as_dict, as_markdown, as_text, citations

__all__ = [
    "DERIVATIVES",
    "Agreement",
    "Check",
    "Derivative",
    "Row",
    "as_dict",
    "as_markdown",
    "as_text",
    "check_derivatives",
    "citations",
    "verify",
]
