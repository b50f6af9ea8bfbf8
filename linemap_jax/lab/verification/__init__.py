"""The paper's mathematics, equation by equation: derivatives by hand and by autodiff, and where the print is wrong."""

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
