"""The proof of the mathematics, and that it can fail: a proof that cannot is none."""

import ast
import dataclasses
import json
import math
import runpy
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from readme import read_part

from linemap_jax.cli import main
from linemap_jax.core import lines
from linemap_jax.lab import verification
from linemap_jax.lab.verification import (
    DERIVATIVES,
    Agreement,
    Check,
    Row,
    as_dict,
    as_markdown,
    as_text,
    check_derivatives,
    citations,
    derivatives,
    equations,
    verify,
)
from linemap_jax.lab.verification.tables import cited

ROOT = Path(__file__).resolve().parents[2]

EXACT = "1 2 3 4 5 6 7 8 9 11 15 20 s3 s4.2.4 s5.1.1 s6.3".split()
ERRATA = "10 12 13 14 16 17 22 24 s4.2.3 s4.2.5 s4.3.1 s5.2.2".split() + ["Table I"]
ASSUMPTIONS = "18 19 21 23 25 s5.1.2 s5.2.1 s6.2".split()

NAMES = [entry.name for entry in DERIVATIVES]
BY_NAME = dict(zip(NAMES, DERIVATIVES, strict=True))


@pytest.fixture(scope="module")
def agreements() -> list[Agreement]:
    """What the registry finds, in a process that is in float32 otherwise."""
    with jax.enable_x64(False):
        found = check_derivatives()
        assert jnp.zeros(()).dtype == np.float32
    return found


@pytest.fixture(scope="module")
def rows(agreements: list[Agreement]) -> dict[str, Row]:
    """The table, likewise."""
    with jax.enable_x64(False):
        found = verify(agreements)
        assert jnp.zeros(()).dtype == np.float32
    return {row.equation: row for row in found}


# --- The equations --------------------------------------------------------------------------------------------------


def test_every_equation_has_one_row_and_they_stand_in_order(rows: dict[str, Row]) -> None:
    assert list(rows)[:25] == [str(n) for n in range(1, 26)]
    assert list(rows)[25:-1] == sorted(list(rows)[25:-1])
    assert set(rows) == {*EXACT, *ERRATA, *ASSUMPTIONS}


@pytest.mark.parametrize("equation", [*EXACT, *ERRATA, *ASSUMPTIONS])
def test_equation(rows: dict[str, Row], equation: str) -> None:
    row = rows[equation]
    assert [check for check in row.checks if not check.passed] == []
    assert row.passed
    assert row.verdict == ("exact" if equation in EXACT else "erratum" if equation in ERRATA else "assumption")
    assert (row.as_printed is None) == (equation in EXACT)
    assert row.difference.limit <= 1e-10
    assert row.sentence.endswith(".")


@pytest.mark.parametrize(
    ("equation", "value"),
    [
        ("10", math.pi),  # the normal turned round
        ("16", 2),  # the wrong sign
        ("s4.2.5", 2),
        ("18", math.pi / 4),  # centroid of the near half of a rim that is seen from far away, in radii
        ("19", 1 - math.sqrt(1 - (math.pi / 4) ** 2)),
        ("22", 0.1 - math.exp(-2.5)),
        ("24", 1 / 2),
        ("25", 1 / 3),  # v = (v + 1) / 4
    ],
)
def test_by_how_much_the_print_is_wrong(rows: dict[str, Row], equation: str, value: float) -> None:
    # The pole is 30 radii away, where less than its half is seen.
    rel = {"18": 0.03, "19": 0.1}.get(equation, 1e-9)
    printed = rows[equation].as_printed
    assert printed is not None
    assert printed.value == pytest.approx(value, rel=rel)


def test_the_lever_arms_of_table_1(rows: dict[str, Row]) -> None:
    # rho (m), and the columns of sigmas, in cm and deg
    table = [(11.55, 99, 0.64), (7.62, 41, 0.35), (16.13, 1109, 4.5), (16.54, 9, 0.08), (17.14, 28, 0.27)]
    table += [(19.53, 33, 0.17)]
    as_sigma = [sigma / 100 / math.radians(theta) for _, sigma, theta in table]
    as_variance = [math.sqrt(sigma) / 100 / math.radians(math.sqrt(theta)) for _, sigma, theta in table]
    assert [round(min(as_sigma)), round(max(as_sigma))] == [59, 141]
    assert [round(min(as_variance)), round(max(as_variance))] == [6, 9]
    printed = rows["Table I"].as_printed
    assert printed is not None
    assert printed.value == pytest.approx(min(arm / rho for arm, (rho, _, _) in zip(as_sigma, table, strict=True)))


# --- The derivatives ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", NAMES)
def test_derivative(agreements: list[Agreement], name: str) -> None:
    mine = [agreement for agreement in agreements if agreement.name == name]
    assert len(mine) >= 9
    for found in mine:
        assert found.finite, found
        assert max(found.literal, found.reverse, found.estimate) <= 1e-10, found
        assert (found.analytic or 0) <= 1e-10, found
        assert (found.autodiff or 0) <= 1e-10, found
        assert found.central <= 1e-6, found
    # Something was computed: central differences are never equal to the last digit.
    assert max(found.central for found in mine) > 0
    # Circles have no hand-derived derivative in the pipeline, since it needs none.
    assert all((found.analytic is None) == ("circle" in name) for found in mine if found.central > 0)


@pytest.mark.parametrize(
    ("name", "kinds"),
    [
        (
            "J (m, q)",
            "horizontal|45 degrees, |flat|near|through the origin|10 km away|3 points|1000 points|reversed|exact",
        ),
        ("J (s, t)", "vertical|steep|near|through the origin|10 km away|3 points|1000 points|reversed|exact"),
        ("H (m, q)", "slope 0,|slope 1,|slope -1,|intercept 0|intercept 1e-09|intercept 1e+04|reversed"),
        ("H (s, t)", "slope 0,|slope 1,|slope -1,|intercept 0|intercept 1e-09|intercept 1e+04|reversed"),
        ("line by points", "horizontal|vertical|45 degrees, |through the origin|10 km away|3 points|1000 points|equal"),
        (
            "line by pose and beams",
            "horizontal|vertical|45 degrees, |wall through the origin|10 km away|3 points|1000 points|equal",
        ),
        (
            "most likely line by pose and beams",
            "horizontal|vertical|45 degrees, |through the origin|10 km away|reversed",
        ),
        ("circle by points", "near|through the origin|10 km away|2 points|3 points|1000 points|vertical|equal"),
        ("fused line", "equal|far better|correlated|3.14 rad|-3.14 rad"),
    ],
)
def test_the_nasty_inputs_are_there(agreements: list[Agreement], name: str, kinds: str) -> None:
    cases = [agreement.case for agreement in agreements if agreement.name == name]
    assert len(set(cases)) == len(cases)
    for kind in kinds.split("|"):
        assert any(kind in case for case in cases), kind


def spoilt(function: Callable[..., Any]) -> Callable[..., Any]:
    """The function with its first number too large by 1e-7 of itself and of one."""

    def wrong(*args: Any) -> Any:
        right = function(*args)
        first = (0,) * right.ndim
        if isinstance(right, np.ndarray):
            right = right.copy()
            right[first] += 1e-7 * (1 + abs(right[first]))
            return right
        return right.at[first].add(1e-7 * (1 + jnp.abs(right[first])))

    return wrong


@pytest.mark.parametrize("name", ["F", "H (m, q)"])
@pytest.mark.parametrize("part", ["analytic", "literal", "model", "estimate"])
def test_a_small_mistake_is_found(name: str, part: str) -> None:
    entry = BY_NAME[name]
    entry = dataclasses.replace(entry, **{part: spoilt(getattr(entry, part))})
    found = list(derivatives.check(entry, np.random.default_rng(0)))

    def worst(field: str) -> float:
        return max(getattr(agreement, field) for agreement in found)

    assert (worst("analytic") > 1e-10) == (part in ("analytic", "estimate"))
    assert (worst("literal") > 1e-10) == (part in ("analytic", "literal", "estimate"))
    assert (worst("estimate") > 1e-10) == (part in ("model", "estimate"))
    assert worst("reverse") <= 1e-10


def test_a_derivative_that_is_not_a_number_is_found() -> None:
    def root_of_square(x: jax.Array, *given: jax.Array) -> jax.Array:
        right = BY_NAME["H (m, q)"].estimate(x, *given)
        return right + 0 * jnp.sqrt(x[1] ** 2)  # no derivative at zero

    entry = dataclasses.replace(BY_NAME["H (m, q)"], estimate=root_of_square)
    found = list(derivatives.check(entry, np.random.default_rng(0)))
    assert {agreement.finite for agreement in found} == {True, False}
    assert all("intercept 0" in agreement.case for agreement in found if not agreement.finite)
    # And a difference that is not a number is no agreement.
    checks = equations.of_derivatives(found, "H (m, q)")
    assert not all(check.passed for check in checks)


def test_the_swapped_labels_of_the_print_would_be_found(monkeypatch: pytest.MonkeyPatch) -> None:
    right = lines.jac_line_regression
    monkeypatch.setattr(lines, "jac_line_regression", lambda fit, anchor: jnp.swapaxes(right(fit, anchor), -1, -2))

    def anew(*args: Any) -> Any:  # another function, since what is compiled is kept
        return derivatives._line_by_regression(*args)

    entry = dataclasses.replace(BY_NAME["H (m, q)"], analytic=anew)
    found = list(derivatives.check(entry, np.random.default_rng(0)))
    assert max(agreement.analytic or 0 for agreement in found) > 0.1


def test_the_literals_share_nothing_with_the_pipeline() -> None:
    source = (ROOT / "linemap_jax/lab/verification/literals.py").read_text()
    imports = [node for node in ast.walk(ast.parse(source)) if isinstance(node, ast.Import | ast.ImportFrom)]
    names = {node.module if isinstance(node, ast.ImportFrom) else node.names[0].name for node in imports}
    assert names == {"numpy", "jaxtyping"}


def test_derivatives_of_many_variables_are_those_of_jacfwd() -> None:
    def function(x: jax.Array) -> jax.Array:
        return jnp.stack([jnp.sum(jnp.sin(x)), jnp.sum(x[1:] * x[:-1])])

    x = jnp.linspace(0.0, 3.0, 101)
    np.testing.assert_allclose(derivatives._forward(function, x), jax.jacfwd(function)(x), rtol=1e-14)


# --- What counts as a proof -----------------------------------------------------------------------------------------

AGREES, DIFFERS = Check("typed", 1e-12), Check("as printed", 0.5, 0.1, differs=True)


def row(verdict: Any, *checks: Check) -> Row:
    return Row(equation="99", title="x", where=(lines.regress,), verdict=verdict, sentence="So.", checks=checks)


@pytest.mark.parametrize("value", [1e-9, math.nan, math.inf])
def test_what_should_agree_must(value: float) -> None:
    assert not Check("typed", value).passed
    assert not row("exact", AGREES, Check("typed", value)).passed


@pytest.mark.parametrize("value", [1e-12, 0.1, math.nan])
def test_a_print_that_suddenly_agrees_is_no_erratum(value: float) -> None:
    agrees = Check("as printed", value, 0.1, differs=True)
    assert not agrees.passed
    assert row("erratum", AGREES, DIFFERS).passed
    assert not row("erratum", AGREES, agrees).passed
    assert not row("erratum", Check("corrected", 0.5), DIFFERS).passed


@pytest.mark.parametrize("verdict", ["erratum", "assumption"])
def test_what_is_not_exact_has_to_be_shown(verdict: str) -> None:
    assert not row(verdict, AGREES).passed
    assert row("exact", AGREES).passed


# --- Tables and citations -------------------------------------------------------------------------------------------


def test_each_row_stands_where_core_cites_its_equation(rows: dict[str, Row]) -> None:
    found = citations()
    assert list(found) == list(range(1, 26))
    for number, names in found.items():
        places = rows[str(number)].places
        modules = [place.rsplit(".", 1)[0] for place in places]
        assert {*places, *modules} & set(names), f"none of {places} cites Eq. ({number})"


@pytest.mark.parametrize(
    ("text", "numbers"),
    [
        ("F of Eq. (4), derived", {4}),
        ("Eqs. (5)-(8) for all", {5, 6, 7, 8}),
        ("see Eqs. (9),\n(10) and (12)", {9, 10, 12}),
        ("the interval (3), section 4.2 (5)", set()),
    ],
)
def test_citations_are_read(text: str, numbers: set[int]) -> None:
    assert cited(text) == numbers


def test_the_readme_holds_the_tables_that_the_code_makes(rows: dict[str, Row]) -> None:
    script = runpy.run_path(str(ROOT / "scripts/write_equation_table.py"))
    assert read_part("equations") == f"\n{script['part_of_readme'](rows.values())}\n", (
        "run scripts/write_equation_table.py --write"
    )


def test_the_tables_say_what_the_rows_say(rows: dict[str, Row]) -> None:
    text, page = as_text(rows.values()), as_markdown(rows.values())
    assert "FAILED" not in text
    for one in rows.values():
        assert one.title in text
        assert one.title in page
        assert one.sentence in page
        assert one.sentence.replace(" ", "") in text.replace(" ", "").replace("\n", "")
    assert all(line.count("|") == 8 for line in page.splitlines())
    broken = dataclasses.replace(rows["12"], checks=(*rows["12"].checks, Check("something", 0.25)))
    assert "(12)      FAILED" in as_text([broken])
    assert "failed: something is 0.25, must be at most 1e-10" in as_text([broken])


@pytest.mark.parametrize("broken", [False, True])
@pytest.mark.parametrize("as_json", [False, True])
def test_the_command(
    rows: dict[str, Row], broken: bool, as_json: bool, monkeypatch: Any, capsys: Any, tmp_path: Path
) -> None:
    table = list(rows.values())
    if broken:
        table[3] = dataclasses.replace(table[3], checks=(Check("something", math.inf),))
    monkeypatch.setattr(verification, "verify", lambda: tuple(table))
    monkeypatch.setenv("JAX_COMPILATION_CACHE_DIR", str(tmp_path))  # so that the command line leaves jax as it is
    status = main(["verify", *(["--json"] if as_json else [])])
    out = capsys.readouterr().out
    assert status == (1 if broken else 0)
    if as_json:
        told = json.loads(out)
        assert told == json.loads(json.dumps([as_dict(one) for one in table]))
        assert [one["passed"] for one in told] == [one.passed for one in table]
        assert {"equation", "where", "difference", "as_printed", "verdict", "sentence", "checks"} <= told[0].keys()
    else:
        assert ("FAILED" in out) == broken
        assert out.count("assumption") >= 5
