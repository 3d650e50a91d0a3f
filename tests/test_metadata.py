"""What is told of the program in several files is the same in all of them."""

import re

import pytest
from helpers import ROOT

import signorini_cr


@pytest.mark.serial
@pytest.mark.parametrize("file", ["CITATION.cff", "conda/recipe.yaml", "CHANGELOG.md"])
def test_one_version(file):
    text = (ROOT / file).read_text(encoding="utf-8")
    found = re.search(r"^(?: *version:|## (?=\d)) *\"?([\d.]+)", text, re.MULTILINE)
    assert found and found[1] == signorini_cr.__version__


@pytest.mark.serial
def test_the_recipe_asks_for_what_the_environment_has():
    def packages(file, start):
        text = (ROOT / file).read_text(encoding="utf-8")
        block = re.search(rf"^ *{start}:\n((?: +- .*\n)+)", text, re.MULTILINE)
        return {line.strip(" -") for line in block[1].splitlines() if "python >" not in line}

    assert packages("conda/recipe.yaml", "run") <= packages("environment.yml", "dependencies")
