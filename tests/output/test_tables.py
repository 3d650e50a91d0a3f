"""Lines that are printed beside the table."""

import re

import pytest

from signorini_cr.output import series
from signorini_cr.output.meanings import OF_STEPS, PRINTED
from signorini_cr.output.tables import (
    certificate_lines,
    facts,
    legend,
    levels_csv,
    markdown_table,
    short,
    table_header,
    table_row,
    times,
)
from signorini_cr.output.units import Units

RECORD = {
    "level": 0, "cells": 8, "dofs": 16, "h": 0.5, "newton_iterations": 1, "linear_iterations": 3,
    "energy": -2.0, "quantities": {}, "contact": {"active": 2, "length": 1.0,
    "force_bounds": {"lower": None, "upper": None, "reason": "none"}}, "error_h1": None,
    "error_l2": None,
    "bound_h1": 0.26683801, "bound_energy_norm": 0.26683801, "bound_reason": None,
    "energy_bounds": {"lower": -2.68565172, "upper": -2.68529189},
    "seconds": {"mesh": 0.5, "assemble": 0.25, "solve": 1.0, "estimate": None},
}  # fmt: skip


def plain(text):
    """With spaces that break, and what stands under a head behind it."""
    head, *items = [text] if isinstance(text, str) else text
    return " ".join([head, "; ".join(items)]).strip().replace("\u00a0", " ")


@pytest.mark.parametrize(
    ("value", "told"),
    [(0.0, "0.00"), (0.00123, "0.00123"), (0.00099996, "0.00100"), (0.000123, "1.23e-4"),
     (3.0, "3.00"), (999.4, "999"), (999.7, "1.00e3"), (1234.5, "1.23e3"), (9999.7, "1.00e4"),
     (123456.0, "1.23e5"), (None, "-")],
)  # fmt: skip
def test_three_digits_fit_into_a_column(value, told):
    assert short(value) == told and len(told) <= 7


@pytest.mark.parametrize("factor", [1.0, 1e-9, 123.456, 7.1e5])
@pytest.mark.parametrize("bound", [0.26683801, 1.0, 0.1, 0.999999, 2.5e-7])
def test_what_is_printed_as_certain_is_certain(factor, bound):
    ends = {end: factor * value for end, value in RECORD["energy_bounds"].items()}
    text = plain(certificate_lines(RECORD | {"bound_h1": factor * bound, "energy_bounds": ends}))
    number = r"(-?[\d.]+(?:e[+-]?\d+)?)"
    least = float(re.search(f"at most {number};", text)[1])
    low, high, wide = map(float, re.search(rf"\[{number}, {number}\], {number} %", text).groups())
    assert factor * bound <= least * (1 + 1e-12) and least <= 1.011 * factor * bound
    slack = 1e-14 * abs(ends["lower"])  # the last digit of a float
    assert low <= ends["lower"] + slack and ends["upper"] <= high + slack
    width = ends["upper"] - ends["lower"]
    assert wide >= 99.99 * width / -ends["lower"] and wide <= 0.0141
    assert high - low <= 1.21 * width


def test_the_energy_norm_is_told_where_it_is_another_one():
    assert "norm of the energy" not in plain(certificate_lines(RECORD))
    told = plain(certificate_lines(RECORD | {"bound_energy_norm": 0.98765432}))
    assert "; in the norm of the energy it is at most 0.988; J(u)" in told


@pytest.mark.parametrize("exact", [None, 0.5])
def test_some_levels_have_a_bound_and_others_none(exact):
    """As where α jumps on a facet that only some meshes have in contact."""
    bounded = RECORD | {"error_h1": exact, "rate_h1": None, "rate_l2": None, "effectivity": 0.5}
    free = bounded | {"level": 1, "bound_h1": None, "bound_energy_norm": None, "effectivity": None}
    assert table_row(bounded, bounded).split()[-2 if exact else -1] == "0.267"
    assert "none" in table_row(free, bounded).split()
    assert len(table_row(free, bounded)) == len(table_row(bounded, bounded))
    for records in ([bounded, free], [free, bounded]):
        head, _, *rows = markdown_table(records).splitlines()
        place = [name.strip() for name in head.split("|")].index("bound")
        found = [row.split("|")[place].strip() for row in rows]
        assert sorted(found) == ["0.267", "none"]


def test_no_bound_no_figures():
    record = RECORD | {"bound_h1": None, "bound_reason": "no flux"}
    assert certificate_lines(record) == ["no bound of the error: no flux"]


@pytest.mark.parametrize("lower, upper", [(0.24871234, 0.25131234), (0.0, 3.1), (0.25, 0.25)])
def test_the_force_that_is_printed_is_certain(lower, upper):
    bounds = {"lower": lower, "upper": upper, "reason": None}
    text = plain(certificate_lines(RECORD | {"contact": {"force_bounds": bounds}}))
    low, high = map(float, re.search(r"the contact force is in \[(.*?), (.*?)\]", text).groups())
    assert low <= lower and upper <= high
    assert high - low <= 1.21 * (upper - lower)


def test_no_force_but_a_reason():
    bounds = {"lower": None, "upper": None, "reason": "they touch"}
    inflow = {"value": 1.0, "lower": 0.9, "upper": 1.1, "reason": None}
    record = RECORD | {"contact": {"force_bounds": bounds}, "quantities": {"inflow": inflow}}
    text = plain(certificate_lines(record))
    assert "; the contact force has no bounds: they touch; inflow is in [0.90, 1.10]" in text


def test_what_is_certain_is_a_line_each():
    assert [line.split()[0] for line in certificate_lines(RECORD)] == [
        *("certified:", "‖∇_h(u", "J(u)", "the")
    ]


def test_one_step_is_one():
    """And a verb goes with how many there are."""
    none = {"bound_h1": None, "quantities": {"m": {"reason": "they touch"}}, "seconds": 2.0}
    some = {"bound_h1": 1.0, "quantities": {"m": {"reason": None}}, "seconds": 2.0}
    for records, bound, means, time in (
        ([none], "1 of 1 step has", "1 step", "2 s for 1 step, 2 s a step"),
        ([some, none], "1 of 2 steps has", "1 step", "4 s for 2 steps, 2 s a step"),
        ([none, none], "2 of 2 steps have", "2 steps", "4 s for 2 steps, 2 s a step"),
    ):
        assert series.certificate_line(records) == f"{bound} no bound of the error"
        (said,) = series.over_time(records, Units())
        assert said == f"m has no bounds in {means}: they touch"
        assert plain(series.times(records)) == time


@pytest.mark.parametrize(
    ("change", "once"),
    [({}, True), ({"weighted": True}, False), ({"kind": "flux"}, False), ({"upper": 1.2}, False)],
    ids=["the same", "weighted", "a flux", "another part"],
)
def test_the_contact_force_under_another_name_is_told_once(change, once):
    bounds = {"lower": 0.9, "upper": 1.1, "reason": None}
    push = {"kind": "force", "weighted": False, "value": 1.0, **bounds, **change}
    record = RECORD | {"contact": {"force_bounds": bounds}, "quantities": {"push": push}}
    lines = [plain(line) for line in certificate_lines(record)]
    told = "the contact force is in [0.90, 1.10], 20 % wide"
    assert lines[3] == (f"{told} (this is push)" if once else told)
    assert lines[-1].startswith("push is in ") is not once
    assert len(lines) == (4 if once else 5)


@pytest.mark.parametrize("exact", [None, 0.5])
def test_every_printed_column_has_its_word(exact):
    record = RECORD | {"error_h1": exact}
    told = [entry.split(":")[0] for entry in legend(record).split("; ")]
    head = re.sub("(H1|L2) error", r"\1_error", table_header(record)).split()
    named = [name.replace("_", " ") for name in head if name not in ("level", "cells")]
    assert list(dict.fromkeys(named)) == told and set(told) <= set(PRINTED)
    assert "bound: certified, ‖∇_h(u − u_h)‖ is not above it" in legend(record)  # H1 error or not


def test_units_in_texts_are_as_they_were_given():
    """What Matplotlib takes for the end of a formula is escaped for it alone."""
    units = Units(x="a_b$c")
    assert " in\u00a0a_b$c" in legend(RECORD, units) and "\\$" not in legend(RECORD, units)
    assert units.within("x") == " in\u00a0a_b\\$c"


def test_every_column_of_the_steps_has_its_meaning():
    head = series.header().split()
    assert head == list(OF_STEPS) and all(meaning for _, meaning in OF_STEPS.values())
    told = [entry.split(":")[0] for entry in series.legend(Units()).split("; ")]
    assert told == head[1:]  # step is a number


@pytest.mark.parametrize(
    ("contact", "told"),
    [
        (
            {"active": 52, "length": 2.6, "force": 71.4537, "transitions": [[0.0151051, 0.3]],
             "force_bounds": {"lower": 0.0, "upper": 170.0, "reason": None}},
            "length 2.6, force 71; it begins or ends at (0.015, 0.3)",
        ),
        (
            {"active": 3, "length": 0.333333, "force": 0.771593, "transitions": [[0.002, 1e-17]],
             "force_bounds": {"lower": None, "upper": None, "reason": "they touch"}},
            "length 0.33, force 0.7716; it begins or ends at (0, 0)",
        ),
        (
            {"active": 0, "length": 0.0, "force": 0.0, "transitions": [],
             "force_bounds": {"lower": 0.0, "upper": 0.0, "reason": None}},
            "length 0, force 0",
        ),
    ],
)  # fmt: skip
def test_places_and_forces_have_the_digits_that_are_known(contact, told):
    record = {"contact": {"facets": 80, **contact}, "kkt": {"residual": 9e-9, "force_error": 1e-6}}
    text = f"contact on {contact['active']} of 80 facets, {told}"
    assert plain(facts(record)) == text
    record["kkt"] = {"residual": 0.321, "force_error": None}
    assert plain(facts(record)) == (
        f"{text}; not converged as usual, as an option or rounding ends the solver early: the"
        " residual is 0.321 of the load, and how well forces are known is not known"
    )


def test_energies_have_the_digits_that_are_known():
    record = RECORD | {"energy": -2.685465123}
    assert table_row(record).split()[7] == "-2.68547"
    unknown = {"lower": None, "upper": None}
    assert table_row(record | {"energy_bounds": unknown}).split()[7] == "-2.685465"
    step = {"step": 1, "time": 0.5, "active": 2, "length": 1.0, "force": 1.234567}
    assert series.row(record | step, record | step).split()[6:8] == ["1.235", "-2.68547"]
    del record["energy_bounds"]  # as an older version has left it
    assert series.row(record | step, record | step).split()[7] == "-2.685"


def test_a_table_has_the_columns_that_its_first_row_has():
    """Later rows of a run that is resumed may come from a newer version and have more."""
    text = levels_csv([{"step": 1, "seconds": 2.0}, {"step": 2, "energy": -1.0, "seconds": 3.0}])
    assert text == "step,seconds\n1,2.0\n2,3.0\n"


def test_nothing_breaks_between_a_number_and_its_unit():
    text = "".join(certificate_lines(RECORD, Units(force="N")))
    assert "\u00a0% wide" in text and ",\u00a0-2.68" in text


def test_units_stand_where_their_figures_are():
    units = Units(x="mm", force="N/mm")
    bounds = {"lower": 0.9, "upper": 1.1, "reason": None}
    record = RECORD | {"contact": {"active": 2, "length": 1.0, "force_bounds": bounds}}
    bare, told = plain(certificate_lines(record)), plain(certificate_lines(record, units))
    assert told == bare.replace("1.10],", "1.10] N/mm,") != bare
    entries = dict(entry.split(": ") for entry in plain(legend(record, units)).split("; "))
    assert {name for name in entries if entries[name].endswith(" in mm")} == {"h", "contact"}
    heads = [head.strip() for head in markdown_table([record], units).split("\n")[0].split("|")]
    assert {"h, mm", "contact, mm"} < set(heads)
    entries = plain(series.legend(Units(time="h", x="m"))).split("; ")
    measured = [entry.split(":")[0] for entry in entries if re.search(" in (h|m)$", entry)]
    assert measured == ["time", "contact"]
    assert Units.of({**units.record()}) == units and Units().record() == {}


def test_times_add_up():
    text = plain(times([RECORD, RECORD]))
    parts = "meshes 1, assembly 0.5, solver 2, certificate 0"
    assert text == f"3.5 s for all levels: {parts}; level by level 1.8, 1.8"
    assert (
        plain(times([RECORD])) == "1.8 s for all levels: meshes 0.5, assembly 0.25, "
        "solver 1, certificate 0"
    )
    steps = [{"seconds": 80.0}, {"seconds": 70.0}]
    assert plain(series.times(steps)) == "150 s for 2 steps, 75 s a step"
