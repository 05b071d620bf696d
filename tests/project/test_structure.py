"""The structure that a newcomer relies on: rooms that say what is in them, short files, imports without circles."""

import ast
import re
from collections import Counter
from pathlib import Path

import grimp
import pytest
from command_line import ROOT

PACKAGE = ROOT / "simpel_cli"
MODULES = sorted([*PACKAGE.rglob("*.py"), *(ROOT / "simulators").rglob("*.py")])
ROOMS = sorted({path.parent for path in MODULES})


def lines(path: Path) -> int:
    return len(path.read_text().splitlines())


def test_nothing_lies_loose() -> None:
    assert {path.name for path in PACKAGE.glob("*.py")} == {"__init__.py", "errors.py", "main.py"}


@pytest.mark.parametrize("room", ROOMS, ids=lambda room: str(room.relative_to(ROOT)))
def test_a_room_says_what_is_in_it(room: Path) -> None:
    says = ast.get_docstring(ast.parse((room / "__init__.py").read_text()))
    assert says
    assert says.endswith(".")


def test_files_are_short() -> None:
    assert {str(path.relative_to(ROOT)): lines(path) for path in MODULES if lines(path) > 400} == {}
    assert {path.name: lines(path) for path in (PACKAGE / "commands").glob("*.py") if lines(path) > 120} == {}


def test_every_file_says_what_is_in_it() -> None:
    assert [str(p.relative_to(ROOT)) for p in MODULES if not ast.get_docstring(ast.parse(p.read_text()))] == []


def test_no_circle_between_files() -> None:
    """Imports inside functions count, too."""
    graph = grimp.build_graph("simpel_cli", "simulators", cache_dir=None)
    imports = {module: graph.find_modules_directly_imported_by(module) for module in graph.modules}
    left = dict(imports)
    while ends := [module for module, others in left.items() if not any(other in left for other in others)]:
        for module in ends:
            del left[module]
    assert sorted(left) == []


def test_tests_stand_in_the_rooms_of_the_code() -> None:
    rooms = {path.name for path in PACKAGE.iterdir() if path.is_dir()} | {"simulators"}
    others = {"project"}  # what is shipped, and the whole
    for path in (ROOT / "tests").rglob("test_*.py"):
        assert path.parent.name in rooms | others, path


def test_no_two_files_of_tests_have_one_name() -> None:
    """pytest imports them by their names alone: two of one name are an error of the whole run, not of one file."""
    names = Counter(path.name for path in (ROOT / "tests").rglob("test_*.py"))
    assert [name for name, count in names.items() if count > 1] == []


def test_long_tests_exist() -> None:
    """Whoever renames one takes its line in tests/long.txt along."""
    names = (ROOT / "tests" / "long.txt").read_text().split()
    assert names == sorted(set(names))
    for name in names:
        file, *within = name.split("::")
        text = (ROOT / file).read_text()
        assert all(re.search(rf"^ *(class|def) {word}\b", text, re.MULTILINE) for word in within), name


GUIDES = [ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs" / "explanation").glob("life_of_*.md"))]


@pytest.mark.parametrize("guide", GUIDES, ids=lambda path: path.name)
def test_a_guide_names_files_and_functions_that_exist(guide: Path) -> None:
    named = re.findall(r"`([\w/]+(?:\.py|/))(?:: ([\w.]+))?`", guide.read_text())
    assert named
    for file, name in (each for each in named if not each[0].endswith("/x.py")):
        path = next((root / file for root in (PACKAGE, ROOT) if (root / file).exists()), None)
        assert path is not None or "/" not in file, f"{file} is missing"
        if path is not None and name:
            text = path.read_text()
            for part in name.split("."):
                assert re.search(rf"^\s*(?:def|class) {part}\b", text, re.M), f"{file} has no {part}"


def test_links_between_pages_lead_somewhere() -> None:
    """Those of README and CONTRIBUTING; `make docs` checks those of the site."""
    for page in (ROOT / "README.md", ROOT / "CONTRIBUTING.md"):
        for target in re.findall(r"\]\((?!https?:)([^)#]+)", page.read_text()):
            assert (page.parent / target).exists(), f"{page.name}: {target}"


def test_the_readme_is_short() -> None:
    assert lines(ROOT / "README.md") <= 200
