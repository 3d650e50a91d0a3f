"""Figures as they are told: bounds up, intervals outward, the rest to what is known."""

import random
import re
from pathlib import Path

import pytest

import signorini_cr
from signorini_cr.output import series
from signorini_cr.rounding import at_most, digits_of, interval, rounded_up, told

pytestmark = pytest.mark.serial
RANDOM = random.Random(1)
VALUES = [RANDOM.uniform(1, 10) * 10.0**k for k in range(-12, 13) for _ in range(40)]
VALUES += [0.1, 1.0, 0.3, 0.29, 2.675, 99.9, 9.995, 0.0999, 1e-300, 1e300]


@pytest.mark.parametrize("digits", [2, 3])
def test_a_bound_that_is_told_is_one(digits):
    for value in VALUES:
        text = at_most(value, digits)
        assert float(text) >= value
        assert float(text) <= value * (1 + 10 ** (1 - digits)) * (1 + 1e-15)
        assert float(text) == rounded_up(value, digits) == float(f"{float(text):.{digits}g}")
        assert len(re.sub(r"e.*|\.", "", text).strip("0")) <= digits


def test_an_interval_that_is_told_holds_it():
    for value in VALUES:
        for share in (1e-9, 1e-3, 0.7, 3.0):
            for sign in (1, -1):
                lower, upper = sorted((sign * value, sign * value * (1 + share)))
                low, high = map(float, interval(lower, upper)[1:-1].split(", "))
                assert low <= lower and upper <= high
                if value > 1e-290:
                    assert high - low <= 1.21 * (upper - lower) + 1e-14 * value


def test_small_and_round_numbers_are_told_as_people_write_them():
    assert [told(x) for x in (100.0, 0.0, -0.0, 0.25, 1e-7)] == ["100", "0", "0", "0.25", "1e-7"]
    assert at_most(99.1, 2) == "100" and at_most(0.0) == "0" and at_most(float("inf")) == "inf"
    assert interval(0.9, 1.1) == "[0.90, 1.10]" and interval(-0.0, 3.1) == "[0, 3.1]"


@pytest.mark.parametrize(
    ("value", "within", "text"),
    [
        (71.4537, 170.0, "71"),
        (71.4537, 3.1, "71.5"),
        (-2.68546, 3.6e-4, "-2.68546"),
        (-2.68546123, 3.6e-4, "-2.68546"),
        (0.0151051, None, "0.0151051"),
        (123456789.0, None, "123457000"),
        (0.0, 1.0, "0"),
        (1.0, 0.0, "1"),
        (0.000123, 5.0, "0.00012"),
    ],
)
def test_what_is_not_known_is_not_told(value, within, text):
    assert digits_of(value, within) == text


STEP = {
    "step": 1, "time": 0.5, "newton_iterations": 1, "linear_iterations": 2, "active": 0,
    "length": 0.0, "force": 0.0, "energy": -1.0, "bound_h1": 0.12345, "quantities": {},
}  # fmt: skip


def test_the_table_of_steps_tells_bounds():
    assert series.row(STEP, STEP).split()[-1] == "0.124"
    assert series.row(STEP | {"bound_h1": None}, STEP).split()[-1] == "none"


@pytest.mark.parametrize(
    ("change", "told"),
    [
        ({}, "75"),
        ({"weighted": True}, "74.71"),
        ({"kind": "flux"}, "74.71"),
        ({"reason": "none", "upper": None}, "74.71"),
        ({"value": 70.0}, "74.71"),
    ],
    ids=["the force", "weighted", "a flux", "without bounds", "another part"],
)
def test_a_steps_force_has_the_digits_that_are_certain(change, told):
    heat = {"kind": "force", "weighted": False, "value": 74.71, "lower": 52.0, "upper": 98.0}
    record = STEP | {"force": 74.71, "quantities": {"heat": heat | {"reason": None} | change}}
    assert series.row(record, record).split()[6] == told
    for force, four in ((289.0, "289.0"), (0.0, "0.000"), (2.5e-7, "2.500e-7"), (12344.0, "12340")):
        alone = record | {"force": force, "quantities": {}}
        assert series.row(alone, alone).split()[6] == four


def test_nothing_certain_is_formatted_otherwise():
    """No f-string rounds a bound to nearest."""
    for path in Path(signorini_cr.__file__).parent.rglob("*.py"):
        found = re.findall(r"\{[^{}]*bound(?:_h1|_energy_norm)?['\"\])]*:[^{}]*[gef]\}",
                           path.read_text(encoding="utf-8"))  # fmt: skip
        assert not found, (path.name, found)
