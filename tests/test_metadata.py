"""Facts about the program that several files tell are the same in all of them."""

import ast
import importlib
import json
import re
import runpy
import tomllib
from pathlib import Path

import pytest
from helpers import ROOT

import signorini_cr

PACKAGE = Path(signorini_cr.__file__).parent


@pytest.mark.serial
@pytest.mark.parametrize("file", ["CITATION.cff", "conda/recipe.yaml", "CHANGELOG.md"])
def test_one_version(file):
    text = (ROOT / file).read_text(encoding="utf-8")
    found = re.search(r"^(?: *version:|## (?=\d)) *\"?([\d.]+)", text, re.MULTILINE)
    assert found and found[1] == signorini_cr.__version__


@pytest.mark.serial
def test_one_date():
    """Releases have dates, the newest comes first, after what is to come; CITATION.cff has its."""
    changes = (ROOT / "CHANGELOG.md").read_text(encoding="utf-8")
    releases = re.findall(r"^## (\d+)\.(\d+)\.(\d+) \((\d{4}-\d\d-\d\d)\)$", changes, re.MULTILINE)
    headings = re.findall(r"^## (.*)$", changes, re.MULTILINE)
    assert len(releases) == len(headings) - (headings[0] == "Unreleased")
    assert sorted(releases, key=lambda each: tuple(map(int, each[:3])), reverse=True) == releases
    assert sorted((each[3] for each in releases), reverse=True) == [each[3] for each in releases]
    assert f"\ndate-released: {releases[0][3]}\n" in (ROOT / "CITATION.cff").read_text()


@pytest.mark.serial
def test_the_recipe_asks_for_what_the_environment_has():
    def packages(file, start):
        text = (ROOT / file).read_text(encoding="utf-8")
        block = re.search(rf"^ *{start}:\n((?: +- .*\n)+)", text, re.MULTILINE)
        return {line.strip(" -") for line in block[1].splitlines() if "python >" not in line}

    assert packages("conda/recipe.yaml", "run") <= packages("environment.yml", "dependencies")


def slugs(text):
    """The anchors that GitHub gives to the headings of a page."""
    text = re.sub(r"^```.*?^```", "", text, flags=re.MULTILINE | re.DOTALL)
    found = []
    for heading in re.findall(r"^#+ +(.*?) *#*$", text, re.MULTILINE):
        words = re.sub(r"!?\[([^]]*)\]\([^)]*\)", r"\1", heading)
        slug = re.sub(r"[^\w\- ]", "", words.lower()).replace(" ", "-")
        again = sum(re.fullmatch(re.escape(slug) + r"(-\d+)?", each) is not None for each in found)
        found.append(f"{slug}-{again}" if again else slug)
    return set(found)


def test_slugs_are_those_of_github():
    text = "# How to …\n## … give *data*?\n```\n# no\n```\n## A `b_c` κ\n## A [b](c)\n## A b\n"
    assert slugs(text) == {"how-to-", "-give-data", "a-b_c-κ", "a-b", "a-b-1"}


@pytest.mark.serial
@pytest.mark.parametrize("file", ["README.md", "ARCHITECTURE.md", "CONTRIBUTING.md"])
def test_links_lead_somewhere(file):
    text = (ROOT / file).read_text(encoding="utf-8")
    links = re.findall(r"\]\(([^)\s]+)\)", text)
    assert links
    for link in links:
        if link.startswith("https://"):
            continue
        path, _, anchor = link.partition("#")
        target = ROOT / (path or file)
        assert target.exists(), link
        if anchor:
            assert anchor in slugs(target.read_text(encoding="utf-8")), link


@pytest.mark.serial
@pytest.mark.parametrize("file", ["ARCHITECTURE.md", "CONTRIBUTING.md"])
def test_a_change_goes_to_files_that_there_are(file):
    """In tables: `fem/space.py` of the package, `/tests/helpers.py` beside it, or `mesh/`."""
    text = (ROOT / file).read_text(encoding="utf-8")
    rows = "\n".join(line for line in text.splitlines() if line.startswith("| "))
    places = re.findall(r"`(/?[\w/]+(?:\.py|\.md|/))`", rows)
    assert len(places) > 20
    for place in places:
        assert (ROOT / place[1:] if place[0] == "/" else PACKAGE / place).exists(), place


@pytest.mark.serial
def test_the_long_description_does_without_the_folder():
    without = runpy.run_path(str(ROOT / "setup.py"))["without_its_folder"]
    text = without((ROOT / "README.md").read_text(encoding="utf-8"))
    assert "](https://" in text and not re.search(r"\]\((?!https://)", text) and "![" not in text
    assert "a b c" == without("a [b](docs/b.md#x) c")
    assert "**a**\n" == without("![p](p.png)\n\n*of [b](b.md)*\n\n**a**\n")
    assert "**a**\n" == without("![p](p.png)\n\n**a**\n")
    assert "a.\n\nb: c.\n" == without(
        "a.\n[B](b.md) is,\nas [d](d.md).\n\nb: [c](c.md). [D](d.md).\n"
    )
    assert "a\n\nb\n" == without("a\n\n[C](c.md) is. b\n")
    assert "# a\n\nb\n\n" == without("# a\n\nb\n\n## More\n\n[C](c.md) · [D](d.md)\n")
    assert "picture above" not in text and "next to it" not in text


@pytest.mark.serial
@pytest.mark.parametrize(("page", "least"), [("method", 30), ("certificate", 30)])
def test_formulas_lead_to_functions(page, least):
    """Those that the page names exist, and another page tells of each, or of its module."""
    docs = ROOT / "docs"
    text = (docs / f"{page}.md").read_text(encoding="utf-8")
    names = re.findall(r"\{py:\w+\}`(?:[^`<]*<)?([\w.]+)>?`", text)
    assert len(names) > least
    told = "".join((docs / page).read_text(encoding="utf-8") for page in ("inside.md", "python.md"))
    modules = re.findall(r"automodule:: ([\w.]+)$", told, re.MULTILINE)
    for name in names:
        of_module = name.rpartition(".")[0] in modules
        assert of_module or re.search(rf":: {re.escape(name)}$", told, re.MULTILINE), name
        thing = signorini_cr
        for part in name.split(".")[1:]:
            module = f"{thing.__name__}.{part}"
            thing = getattr(thing, part, None) or importlib.import_module(module)
        assert thing.__doc__, name


@pytest.mark.serial
def test_formulas_keep_their_numbers():
    """(1) to (6) are what code and other pages call them; what is referred to has a label."""
    text = (ROOT / "docs" / "certificate.md").read_text(encoding="utf-8")
    labels = re.findall(r"^\$\$ \(([\w-]+)\)$", text, re.MULTILINE)
    assert [label.removeprefix("certificate-") for label in labels[:6]] == [
        "problem", "residual", "gap", "bound", "conforming", "energy",
    ]  # fmt: skip
    assert set(re.findall(r"\{eq\}`([\w-]+)`", text)) <= set(labels)
    assert len(labels) == len(set(labels))


@pytest.mark.serial
def test_numbers_of_the_paper_have_formulas():
    """The method's page has a formula for each that a docstring cites, and refers to its own."""
    text = (ROOT / "docs" / "method.md").read_text(encoding="utf-8")
    formulas = re.findall(r"^\$\$\n(.*?)^\$\$(?: \(([\w-]+)\))?$", text, re.MULTILINE | re.DOTALL)
    tags = re.findall(r"\\tag\{([\d.]+)\}", text)
    assert len(formulas) > 15 and all(("\\tag{" in tex) != bool(label) for tex, label in formulas)
    # Sphinx makes lines of what has any, and MathJax has no tags in there
    assert not any("\\tag{" in tex and "\\\\" in tex for tex, _ in formulas)
    assert set(re.findall(r"\{eq\}`([\w-]+)`", text)) <= {label for _, label in formulas}
    modules = (ROOT / "signorini_cr").rglob("*.py")
    code = "".join(module.read_text(encoding="utf-8") for module in modules)
    cited = set(re.findall(r"(?<![\w)\]}])\(([12]\.\d+)\)", code))
    assert {"1.6", "1.7", "1.8", "2.2"} <= set(tags) and cited <= set(tags), cited ^ set(tags)
    assert len(tags) == len(set(tags))


@pytest.mark.serial
def test_what_is_cited_is_in_the_bibliography():
    """Names with a year have an entry with both, and so have methods named after somebody."""
    entries = (ROOT / "docs" / "bibliography.md").read_text(encoding="utf-8").splitlines()
    name = r"[A-Z][a-zäöüé]+"
    pattern = rf"((?:{name}, )*{name}(?:,? (?:and|&) {name})?),? \(?((?:19|20)\d\d)\b"
    pages = [*(ROOT / "docs").glob("*.md"), *(ROOT / "docs" / "applications").glob("*.md")]
    texts = {page.stem: " ".join(page.read_text(encoding="utf-8").split()) for page in pages}
    texts.pop("bibliography")
    cited = {found for text in texts.values() for found in re.findall(pattern, text)}
    assert ("Payne & Weinberger", "1960") in cited and len(cited) >= 5
    for names, year in cited:
        people = re.findall(name, names)
        assert any(all(word in entry for word in (*people, year)) for entry in entries), names
    for person in ("Marini", "Dörfler"):
        assert any(person in text for text in texts.values())
        assert any(f". {person}: " in entry for entry in entries), person


@pytest.mark.serial
def test_docstrings_say_what_a_thing_is():
    """Of functions in the imperative; of all else, constants among it, by a noun."""
    asked = {"What", "Where", "How", "Which", "Whether", "When", "Why"}
    found = []
    for path in sorted(PACKAGE.rglob("*.py")):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            texts = []
            if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef):
                texts = [
                    each.value.value
                    for each in node.body
                    if isinstance(each, ast.Expr) and isinstance(each.value, ast.Constant)
                ]
            words = [text.split()[0] for text in texts if isinstance(text, str) and text.split()]
            found += [f"{path.relative_to(PACKAGE)}: {word}" for word in words if word in asked]
    assert not found, found


def loaded(path):
    """A YAML file; `make lint` has a reader of them, other runs may not."""
    yaml = pytest.importorskip("yaml", reason="make lint reads YAML")
    return yaml.safe_load((ROOT / path).read_text(encoding="utf-8"))


def project():
    return tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]


@pytest.mark.serial
def test_the_recipe_is_as_conda_forge_asks():
    """Its linter's rules, but for the maintainer and the homepage that there are none of yet."""
    recipe, about = loaded("conda/recipe.yaml"), project()
    assert list(recipe) == [
        "schema_version", "context", "package", "source", "build", "requirements", "tests", "about",
        "extra",
    ]  # fmt: skip
    context, build, needs = recipe["context"], recipe["build"], recipe["requirements"]
    assert context["name"] == about["name"] and re.fullmatch(r"[a-z0-9_.-]+", context["name"])
    assert about["requires-python"] == f">={context['python_min']}"
    assert build["noarch"] == "python" and build["number"] == 0
    assert "--no-deps" in build["script"] and "--no-build-isolation" in build["script"]
    scripts = [f"{name} = {place}" for name, place in about["scripts"].items()]
    assert build["python"]["entry_points"] == scripts
    assert {"python ${{ python_min }}.*", "pip", "setuptools >=77"} == set(needs["host"])
    assert needs["run"][0] == "python >=${{ python_min }}"
    for line in needs["host"] + needs["run"]:
        assert re.fullmatch(r"[a-z0-9_-]+( (>=|<|==)?[\w.*${} ]+)?", line), line
    assert {each.replace(">=", " >=") for each in about["dependencies"]} <= set(needs["run"])
    imports, command = recipe["tests"]
    assert imports["python"]["imports"] and imports["python"]["pip_check"]
    assert "${{ python_min }}.*" in imports["python"]["python_version"]
    assert all((ROOT / file).is_file() for file in command["files"]["source"])
    told = recipe["about"]
    assert told["license"] == about["license"]
    assert [told["license_file"]] == about["license-files"] and (
        ROOT / told["license_file"]
    ).is_file()
    assert told["summary"] == about["description"] and not told["summary"].endswith(".")
    assert isinstance(recipe["extra"]["recipe-maintainers"], list)
    assert (ROOT / "conda" / recipe["source"]["path"] / "pyproject.toml").is_file()


@pytest.mark.serial
def test_images_are_made_of_files_that_exist():
    for file in ("Dockerfile", ".devcontainer/Dockerfile"):
        text = (ROOT / file).read_text(encoding="utf-8")
        sources = re.findall(r"^COPY (\S+) \S+$", text, re.MULTILINE)
        assert sources and all((ROOT / source).exists() for source in sources), file
    recipe = (ROOT / "container" / "signorini_cr.def").read_text(encoding="utf-8")
    sections = re.split(r"^%(\w+)\n", recipe, flags=re.MULTILINE)
    parts = dict(zip(sections[1::2], sections[2::2], strict=True))
    assert set(parts) == {"files", "post", "environment", "runscript", "test", "help"}
    assert sections[0].endswith("Bootstrap: docker\nFrom: debian:trixie-slim\n\n")
    for line in filter(None, parts["files"].partition("#")[0].splitlines()):
        source, target = line.split()
        there = PACKAGE if source == "signorini_cr" else ROOT / source
        assert there.exists() and target == f"/opt/signorini_cr/{source}"
    editor = json.loads((ROOT / ".devcontainer/devcontainer.json").read_text(encoding="utf-8"))
    assert (ROOT / ".devcontainer" / editor["build"]["dockerfile"]).is_file()
    assert (ROOT / ".devcontainer" / editor["build"]["context"] / "Makefile").is_file()
    # The settings of container/run, in all of them
    settings = {**editor["containerEnv"], "PYTHONPATH": "", "PATH": ""}
    image = (ROOT / "Dockerfile").read_text(encoding="utf-8")
    for name, value in settings.items():
        assert f"{name}={value}" in image and f"export {name}={value}" in parts["environment"]
    # Unlike the others this image is built and tested by root
    for name in ("OMPI_ALLOW_RUN_AS_ROOT", "OMPI_ALLOW_RUN_AS_ROOT_CONFIRM"):
        assert f"    export {name}=1\n" in parts["environment"]


@pytest.mark.serial
def test_the_environment_of_conda():
    environment = loaded("environment.yml")
    assert environment["channels"] == ["conda-forge", "nodefaults"]
    needed = {line.replace(" ", "") for line in environment["dependencies"]}
    assert {*project()["dependencies"], *project()["optional-dependencies"]["test"]} <= needed


@pytest.mark.serial
def test_workflows_call_what_exists():
    make = set(re.findall(r"^([\w-]+):", (ROOT / "Makefile").read_text(), re.MULTILINE))
    tools = (ROOT / "container" / "tools.txt").read_text()
    lines = []
    for job in loaded(".github/workflows/ci.yml")["jobs"].values():
        assert job["timeout-minutes"] and job["runs-on"]
        lines += [step["run"] for step in job["steps"] if "run" in step]
        assert all("run" in step or "@" in step["uses"] for step in job["steps"])
    for hook in loaded(".pre-commit-config.yaml")["repos"][0]["hooks"]:
        lines.append(hook["entry"])
        tool = re.search(r"container/tool (\w+)", hook["entry"])[1]
        assert f"{tool}==" in tools
    called = set()
    for line in lines:
        for goals in re.findall(r"^make ((?:[\w-]+ ?)+)$", line):
            assert set(goals.split()) <= make, line
            called |= set(goals.split())
        assert all((ROOT / file).is_file() for file in re.findall(r"container/[\w.-]+", line)), line
    script = (ROOT / ".ci" / "run").read_text(encoding="utf-8")
    stages = set(re.findall(r"SUITE=\w+ make ([\w-]+)", script))
    parts = {"test-alone", "test-first", "test-pair", "quick-pair", "ranks-3", "ranks-4"}
    assert stages - {"ranks-3", "ranks-4"} <= make
    assert "docs" in stages and stages - parts | {"test", "ranks"} <= called
    for template in (ROOT / ".github" / "ISSUE_TEMPLATE").glob("*.yml"):
        form = loaded(template.relative_to(ROOT))
        assert form["name"] and form["description"] and form["body"]
