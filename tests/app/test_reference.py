"""The reference's pages against what the program reads, takes, prints, writes and offers."""

import csv
import importlib.util
import json
import re
import runpy
from dataclasses import fields
from inspect import signature
from pathlib import Path

import pytest
import ufl
from dolfinx.fem import assemble_scalar, form
from helpers import HELD_ABOVE, ROOT
from mpi4py import MPI

import signorini_cr
from signorini_cr import options, solve
from signorini_cr.adaptive import adapt_to_run
from signorini_cr.app.cli import main
from signorini_cr.app.commandline import UsageError, _parser, read_arguments
from signorini_cr.app.problemfile import load
from signorini_cr.app.reference import ABOUT, ADAPTIVE, KEYS, MATERIAL, PART, QUANTITY, TYPES
from signorini_cr.fem.conditions import Contact, Robin
from signorini_cr.fem.problem import Material, Problem
from signorini_cr.output.meanings import PRINTED
from signorini_cr.output.sheets import SHEETS
from signorini_cr.output.units import Units

BASE = {
    "domain": {
        "vertices": "vertices = [[-1, 0], [1, 0], [1, 1], [-1, 1]]",
        "boundary": 'boundary = ["contact", "dirichlet", "neumann", "dirichlet"]',
        "size": "size = 0.5",
    },
    "data": {"obstacle": 'obstacle = "-1"'},
}


DOCS = ROOT / "docs"
PACKAGE = Path(signorini_cr.__file__).parent
PAGES = runpy.run_path(str(DOCS / "reference.py"))["PAGES"]


@pytest.mark.serial
@pytest.mark.parametrize("name", PAGES)
def test_the_pages_are_those_of_the_tables(name) -> None:
    found = (DOCS / name).read_text(encoding="utf-8")
    assert found == PAGES[name](), f"docs/{name}: run docs/reference.py"


@pytest.mark.serial
def test_every_option_is_in_the_reference() -> None:
    text = (DOCS / "command.md").read_text(encoding="utf-8")
    parser, commands = _parser()
    words = [*commands]
    for each in (parser, *commands.values()):
        words += each._option_string_actions
    assert [word for word in words if not re.search(rf"(?<!\w){word}\b", text)] == []


@pytest.mark.serial
def test_every_prefix_of_petsc_options_is_in_the_reference() -> None:
    text = (DOCS / "command.md").read_text(encoding="utf-8")
    for name, prefix in vars(options).items():
        if name.endswith("_PREFIX"):
            assert f"| `-{prefix}` |" in text, name
    code = "".join(p.read_text(encoding="utf-8") for p in PACKAGE.rglob("*.py"))
    own = set(re.findall(r"\bread_(?:word|number)\(\"(\w+)\"", code))
    assert own == {"smoother", "snes_atol", "ksp_norm_type"}
    assert f"`-{options.PREFIX}smoother " in text


@pytest.mark.slow
@pytest.mark.serial
def test_the_tutorial_prints_what_the_program_prints(tmp_path, capsys) -> None:
    """The statement of the problem, the head of the table and its first rows."""
    page = (DOCS / "tutorial.md").read_text(encoding="utf-8")
    file, shown = tmp_path / "membrane.toml", re.search(r"```text\n(.*?)```", page, re.S)[1]
    file.write_text(re.search(r"```toml\n(.*?)```", page, re.S)[1], encoding="utf-8")
    words = ["solve", str(file), "--levels", "2", "--out", str(tmp_path / "out")]
    assert main(words) == 0
    printed = capsys.readouterr().out.splitlines()
    shown = shown.splitlines()
    if shown[0] != printed[0]:
        pytest.skip("another gmsh has made another mesh")
    head = shown.index("") + 1
    assert shown[: head + 1] == printed[: head + 1]
    cg = shown[head].split().index("cg")  # depends on the ranks, which there are two of there
    for before, now in zip(shown[head + 1 : head + 3], printed[head + 1 : head + 3], strict=True):
        assert before.split()[:cg] == now.split()[:cg]
        assert before.split()[cg + 1 :] == now.split()[cg + 1 :]


def names_in(head: str) -> list[str]:
    """The names in a table of the page of figures, in order."""
    text = (DOCS / "figures.md").read_text(encoding="utf-8")
    (section,) = (part for part in text.split("\n## ") if part.startswith(head))
    return re.findall(r"^\| `(.*?)` \|", section, re.M)


def dotted(record: dict, before: str = "") -> list[str]:
    """The keys of a record, those of an object behind a dot."""
    found = []
    for key, value in record.items():
        if isinstance(value, dict):
            found += dotted(value, f"{before}{key}.")
        else:
            found.append(before + key)
    return found


@pytest.mark.slow
@pytest.mark.parametrize("known", [True, False])
def test_every_figure_is_in_the_reference(known, shared_tmp_path, capsys) -> None:
    """All that a run prints and writes, and nothing else."""
    path, folder = shared_tmp_path / "case.toml", shared_tmp_path / "out"
    lines = [*BASE["domain"].values(), "[data]", *BASE["data"].values()]
    if known:
        lines += ["[exact]", 'u = "(1 - x**2)*(1 - y)"']
    if MPI.COMM_WORLD.rank == 0:
        path.write_text("\n".join(["[domain]", *lines, ""]), encoding="utf-8")
    MPI.COMM_WORLD.Barrier()
    assert main(["solve", str(path), "--out", str(folder)]) == 0
    if MPI.COMM_WORLD.rank > 0:
        return
    report = json.loads((folder / "report.json").read_text(encoding="utf-8"))
    assert report["levels"][0].get("quantities") == {}  # of which each file has its own
    (level,) = report["levels"]
    named = names_in("Keys of report.json")
    elsewhere = ("units", "names", "search", "times")
    assert dotted(report) == [name for name in named if name not in elsewhere]
    assert dotted(level | {"quantities": None}) == names_in("Keys of a level")
    head = next(csv.reader((folder / "levels.csv").read_text(encoding="utf-8").splitlines()))
    assert head == [name.replace(".", "_") for name in dotted(level) if name != "quantities"]
    head = next(csv.reader((folder / "contact.csv").read_text(encoding="utf-8").splitlines()))
    named = names_in("Columns of contact.csv")
    # not bounded from above, on one part
    assert head == [name for name in named if name not in ("upper", "name")]
    for name, sheet in SHEETS.items():
        head = next(csv.reader((folder / name).read_text(encoding="utf-8").splitlines()))
        assert head and head == [each for each in names_in(sheet.head) if each in head]
    (head,) = (line for line in capsys.readouterr().out.splitlines() if line.startswith("level "))
    printed = head.replace("H1 error", "H1_error").replace("L2 error", "L2_error").split()
    known_names = names_in("Columns of the printed table")
    assert {name.replace("_", " ") for name in printed} <= set(known_names)
    whole = set(known_names) - {name.replace("_", " ") for name in printed}
    assert whole == ({"cells", "energy", "contact"} if known else
                     {"H1 error", "L2 error", "rate", "eff."})  # fmt: skip


@pytest.mark.serial
def test_the_meaning_of_the_energy_has_all_its_terms() -> None:
    """Each of them is more than rounding here, and together they are the figure."""
    domain = HELD_ABOVE.mesh(0.5)
    lossy = {"coefficient": 3.0, "external": 0.5}
    sides = dict.fromkeys(("neumann", "dirichlet"), Robin(0.7, **lossy))
    held = {"contact": Contact(-9.0, g=0.7, **lossy), **sides}
    problem = Problem(f=1.1, reaction=2.0, coefficient=1.5, conditions=held)
    solution = solve(problem, domain)
    u = solution.u
    terms = {
        "½∫κ∇u_h·∇u_h": 0.75 * ufl.inner(ufl.grad(u), ufl.grad(u)) * ufl.dx,
        "− ∫f u_h": -1.1 * u * ufl.dx,
        "− ∫g u_h": -0.7 * u * ufl.ds,
        "½∫c u_h²": u**2 * ufl.dx,
        "½∫b u_h²": 1.5 * u**2 * ufl.ds,
        "− ∫b u_ext u_h": -1.5 * u * ufl.ds,
    }
    values = [domain.mesh.comm.allreduce(assemble_scalar(form(each))) for each in terms.values()]
    assert min(map(abs, values)) > 1e-5
    assert sum(values) == pytest.approx(solution.energy, rel=1e-10)
    for words in terms:
        assert words in PRINTED["energy"][1] and words in (DOCS / "tutorial.md").read_text()


def test_every_public_name_is_in_the_reference() -> None:
    text = (DOCS / "python.md").read_text(encoding="utf-8")
    told = set(re.findall(r"(?::: signorini_cr|`scr)\.(\w+)(?:\n|`)", text))
    assert set(signorini_cr.__all__) <= told
    modules = [
        name
        for name, place in signorini_cr._MODULES.items()
        if not re.search(rf":: signorini_cr\.({place}|{name})\b", text)
    ]
    assert modules == []
    assert {*signorini_cr.__all__, *signorini_cr._MODULES} <= set(dir(signorini_cr))


@pytest.mark.serial
@pytest.mark.parametrize("short", sorted(signorini_cr._MODULES))
def test_modules_are_imported_by_their_short_names(short: str) -> None:
    """One module by either name, which `importlib.reload` finds as well."""
    module = importlib.import_module(f"signorini_cr.{short}")
    place = f"signorini_cr.{signorini_cr._MODULES[short]}"
    assert module is getattr(signorini_cr, short) is importlib.import_module(place)
    assert module.__name__ == module.__spec__.name == place
    assert importlib.util.find_spec(place).origin == module.__file__


@pytest.mark.serial
def test_only_the_short_names_are_imported() -> None:
    with pytest.raises(ModuleNotFoundError, match=r"No module named 'signorini_cr\.exactly'"):
        importlib.import_module("signorini_cr.exactly")
    with pytest.raises(ModuleNotFoundError, match="No module named 'exact'"):
        importlib.import_module("exact")


@pytest.mark.serial
def test_every_name_that_the_documents_use_is_in_the_reference() -> None:
    files = [ROOT / "README.md", ROOT / "demos" / "slope.ipynb", *DOCS.glob("*.md")]
    text = "\n".join(file.read_text(encoding="utf-8") for file in files)
    used = set(re.findall(r"\bscr\.(\w+(?:\.\w+)*)", text))
    for module, names in re.findall(r"from signorini_cr(\S*) import ([\w, ]+)", text):
        used |= {f"{module}.{name}".removeprefix(".") for name in names.split(", ")}
    assert {"plots.Units", "output.strip.moment"} <= used
    told = (DOCS / "python.md").read_text(encoding="utf-8")
    assert [name for name in used if not re.search(rf"`(?:scr\.)?{name}[(`]", told)] == []


@pytest.mark.serial
@pytest.mark.parametrize("key", KEYS, ids=lambda key: f"{key.section}.{key.name}")
def test_examples_are_read(key, tmp_path: Path) -> None:
    """Each in the place of its key in a file that is in order."""
    sections = {name: dict(BASE.get(name, {})) for name in ABOUT}
    if key.name == "mesh":
        sections["domain"] = {}
    if key.section == "refine":
        sections["refine"]["mode"] = 'mode = "adaptive"'
    if key.section == "time":
        sections["time"] = {"end": "end = 1", "steps": "steps = 2"}
    if key.section == PART:
        kind = next((kind for kind, keys in TYPES.items() if key.name in keys), "")
        sections[PART]["type"] = f'type = "{kind}"'
        sections["domain"]["boundary"] = 'boundary = ["contact", "dirichlet", "NAME", "NAME"]'
    if key.section == MATERIAL:
        sections[MATERIAL]["polygon"] = "polygon = [[0, 0], [1, 0], [0, 1]]"
    if (key.section, key.name) == (QUANTITY, "weight"):
        sections[QUANTITY]["force"] = 'force = "contact"'
    sections[key.section][key.name] = key.example
    lines = [*sections.pop("").values()]
    for name, rows in sections.items():
        lines += [f"[{name}]", *rows.values()] if rows else []
    path = tmp_path / "case.toml"
    path.write_text("\n".join(lines), encoding="utf-8")
    load(path, MPI.COMM_SELF)


def test_every_expression_of_the_table_is_used() -> None:
    """A datum that nothing asks for would be read and forgotten."""
    for section, has in (("data", Problem), ("material.NAME", Material)):
        keys = {key.name for key in KEYS if key.section == section and key.is_expression}
        assert keys and keys <= {each.name for each in fields(has)}
    for section in (PART, QUANTITY, "exact", "time"):
        assert any(key.section == section and key.is_expression for key in KEYS)
    keys = {key.name for key in KEYS if key.section == PART} - {"type"}
    assert keys == {name for names in TYPES.values() for name in names}


@pytest.mark.serial
def test_every_field_is_in_both_tables() -> None:
    text = (DOCS / "howto.md").read_text(encoding="utf-8")
    tables = [
        text.partition(head)[2].partition("\n\n")[0] for head in ("| field |", "| function |")
    ]
    problem = Problem(conditions={"contact": Contact(-1.0, upper=1.0)})
    for name in solve(problem, HELD_ABOVE.mesh(0.5)).functions():
        assert all(f"`{name}`" in table for table in tables), name


def test_runs_in_time_seek_their_mesh_by_the_same_keys() -> None:
    in_time = signature(adapt_to_run).parameters
    for name, (_, default) in ADAPTIVE.items():
        assert name in in_time and in_time[name].default == default, name


@pytest.mark.parametrize("key", KEYS, ids=lambda key: f"{key.section}.{key.name}")
def test_a_key_that_is_taken_for_an_option_is_told(key) -> None:
    """Those of sections; that of the top of the file is nothing that one would look for."""
    words = ["solve", "FILE", f"--{key.name.replace('_', '-')}=1"]
    if f"--{key.name}" in _parser()[1]["solve"]._option_string_actions:
        return
    sections = {f"[{each.section}]" for each in KEYS if each.name == key.name}
    with pytest.raises(UsageError) as caught:
        read_arguments(words)
    told = re.search(r"; (\w+) is a key of (\[\S+\]) in the problem file", str(caught.value))
    assert (told and told[1] == key.name and told[2] in sections) or (
        told is None and not key.section
    )


@pytest.mark.serial
def test_units_are_told_by_the_keys_of_their_section() -> None:
    keys = {key.name for key in KEYS if key.section == "units"}
    assert keys == {each.name for each in fields(Units)} - {"names"}


@pytest.mark.serial
def test_every_key_of_the_ready_files_is_in_the_table() -> None:
    import tomllib

    known = {(key.section, key.name) for key in KEYS}
    for path in (ROOT / "meshes").glob("*.toml"):
        table = tomllib.loads(path.read_text(encoding="utf-8"))
        for section, content in table.items():
            if section in ("define", "quantities"):  # names of one's own
                continue
            parts = {section: content}
            if section in ("boundary", "material"):
                whole = {"boundary": PART, "material": MATERIAL}[section]
                parts = {f"{whole} {name}": part for name, part in content.items()}
            for name, part in parts.items():
                keys = part if isinstance(part, dict) else [name]
                where = name.split()[0] if isinstance(part, dict) else ""
                assert {(where, key) for key in keys} <= known, path.name
