"""The paper's mathematics, equation by equation: derivatives by hand and by autodiff, and where the print is wrong.

The modules in their order:

  literals        the paper's formulas in plain NumPy, and their derivatives as derived by hand
  cases           inputs on which formulas for lines break
  derivatives     what holds the derivatives against one another
  sample          walls seen in one scan, through the pipeline
  rows            what a row of the table consists of
  sections        a row for each section that says in words what is computed
  equations       a row for each equation, and all rows: `verify`
  tables          the rows as tables, and which parts of `core` cite which equation
"""

from linemap_jax.lab.verification.derivatives import DERIVATIVES, Agreement, Derivative, check_derivatives
from linemap_jax.lab.verification.equations import verify
from linemap_jax.lab.verification.rows import Check, Row
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
