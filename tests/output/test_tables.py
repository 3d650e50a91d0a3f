"""What is printed beside the table."""

import re

import pytest

from signorini_cr.output import series
from signorini_cr.output.tables import certified, legend, markdown_table, table_header, times
from signorini_cr.output.units import Units

RECORD = {
    "level": 0, "cells": 8, "dofs": 16, "h": 0.5, "newton_iterations": 1, "linear_iterations": 3,
    "energy": -2.0, "quantities": {}, "contact": {"active": 2, "length": 1.0,
    "force_bounds": {"lower": None, "upper": None, "reason": "none"}}, "error_h1": None,
    "error_l2": None,
    "bound_h1": 0.26683801, "bound_reason": None,
    "energy_bounds": {"lower": -2.68565172, "upper": -2.68529189},
    "seconds": {"mesh": 0.5, "assemble": 0.25, "solve": 1.0, "estimate": None},
}  # fmt: skip


@pytest.mark.parametrize("factor", [1.0, 1e-9, 123.456, 7.1e5])
@pytest.mark.parametrize("bound", [0.26683801, 1.0, 0.1, 0.999999, 2.5e-7])
def test_what_is_printed_as_certain_is_certain(factor, bound):
    ends = {end: factor * value for end, value in RECORD["energy_bounds"].items()}
    text = certified(RECORD | {"bound_h1": factor * bound, "energy_bounds": ends})
    number = r"(-?[\d.]+(?:e[+-]?\d+)?)"
    least = float(re.search(f"at most {number};", text)[1])
    low, high, wide = map(float, re.search(rf"\[{number}, {number}\], {number} %", text).groups())
    assert factor * bound <= least * (1 + 1e-12) and least <= 1.011 * factor * bound
    slack = 1e-14 * abs(ends["lower"])  # the last digit of a float
    assert low <= ends["lower"] + slack and ends["upper"] <= high + slack
    width = ends["upper"] - ends["lower"]
    assert wide >= 99.99 * width / -ends["lower"] and wide <= 0.0141
    assert high - low <= 1.21 * width


def test_no_bound_no_figures():
    record = RECORD | {"bound_h1": None, "bound_reason": "no flux"}
    assert certified(record) == "no bound of the error: no flux"


@pytest.mark.parametrize("lower, upper", [(0.24871234, 0.25131234), (0.0, 3.1), (0.25, 0.25)])
def test_the_force_that_is_printed_is_certain(lower, upper):
    bounds = {"lower": lower, "upper": upper, "reason": None}
    text = certified(RECORD | {"contact": {"force_bounds": bounds}})
    low, high = map(float, re.search(r"the contact force is in \[(.*?), (.*?)\]", text).groups())
    assert low <= lower and upper <= high
    assert high - low <= 1.21 * (upper - lower)


def test_no_force_but_a_reason():
    bounds = {"lower": None, "upper": None, "reason": "they touch"}
    inflow = {"value": 1.0, "lower": 0.9, "upper": 1.1, "reason": None}
    record = RECORD | {"contact": {"force_bounds": bounds}, "quantities": {"inflow": inflow}}
    text = certified(record)
    assert "; the contact force has no bounds: they touch; inflow is in [0.9, 1.1]" in text


def test_every_printed_column_has_its_word():
    told = {entry.split(":")[0] for entry in legend(RECORD).split("; ")}
    assert set(table_header(RECORD).split()) - {"level", "cells"} == told


def test_units_stand_where_their_figures_are():
    units = Units(x="mm", force="N/mm")
    bounds = {"lower": 0.9, "upper": 1.1, "reason": None}
    record = RECORD | {"contact": {"active": 2, "length": 1.0, "force_bounds": bounds}}
    plain, told = certified(record), certified(record, units)
    assert told == plain.replace("1.1],", "1.1] N/mm,") != plain
    entries = dict(entry.split(": ") for entry in legend(record, units).split("; "))
    assert {name for name in entries if entries[name].endswith(", in mm")} == {"h", "contact"}
    heads = [head.strip() for head in markdown_table([record], units).split("\n")[0].split("|")]
    assert {"h, mm", "contact, mm"} < set(heads)
    assert series.legend(Units(time="h", x="m")) == "time in h, contact in m"
    assert Units.of({**units.record()}) == units and Units().record() == {}


def test_times_add_up():
    text = times([RECORD, RECORD])
    assert text == "3.5 s for all levels: meshes 1, assembly 0.5, solver 2, certificate 0"
