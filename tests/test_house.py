"""The house rules that a machine can check: who may import whom, sizes, words, where truth is read."""

from __future__ import annotations

import ast
import re
from dataclasses import dataclass
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
SOURCE = ROOT / "src" / "overfly"
MODULES = sorted(SOURCE.rglob("*.py"))
LONGEST_FILE = 420  # 400 is the rule; this is where it stops being a matter of taste

# What a part of the house may import of the package, besides itself; None: all but the command line.
FOUNDATION = ("errors", "types", "files", "timing", "threads", "geometry")
MAY_IMPORT: dict[str, tuple[str, ...] | None] = {
    "errors": (),
    "timing": (),
    "files": ("errors",),
    "geometry": ("errors", "types"),
    "types": ("geometry",),
    "config": ("errors",),
    "vision": ("errors", "types", "geometry", "config", "timing"),
    "graph": ("errors", "types", "files", "geometry"),
    "revisit": ("errors", "types", "geometry", "config", "timing", "vision", "graph", "pieces", "visual_map"),
    "sensors": FOUNDATION,
    "products": (*FOUNDATION, "trajectory", "evaluation", "config"),
    "trajectory": FOUNDATION,
    "evaluation": (*FOUNDATION, "trajectory"),
    "viewer": (
        *FOUNDATION,
        "graph",
        "frame_result",
        "slam",
        "localizer",
        "visual_map",
        "mapstore",
        "products",
        "navigation",
    ),
    "navigation": (*FOUNDATION, "sensors", "localizer", "frame_result", "slam"),
    "simulation": (*FOUNDATION, "trajectory", "sensors", "config"),
}
NO_INPUT_OR_OUTPUT = ("vision", "revisit", "geometry")
INPUT_AND_OUTPUT = {
    "pathlib",
    "io",
    "sqlite3",
    "subprocess",
    "socket",
    "urllib",
    "rasterio",
    "yaml",
    "json",
    "csv",
}
BLIND_TO_TRUTH = ("sensors", "vision", "graph", "revisit", "pipeline", "mapstore", "products", "navigation")
COMPARE_WITH_TRUTH = ("demo.py", "experiments.py")  # commands that map first and evaluate afterwards


@dataclass(frozen=True)
class Import:
    """One import in a file: the imported module and its line."""

    file: Path
    line: int
    module: str

    def __str__(self) -> str:
        return f"{self.file.relative_to(ROOT)}:{self.line} imports {self.module}"


def part_of(path: Path) -> str:
    """Folder or module directly below the package: the part of the house."""
    first = path.relative_to(SOURCE).parts[0]
    return first.removesuffix(".py")


def imports_of(path: Path) -> list[Import]:
    """All imports, those inside functions and for type checkers included."""
    found = []
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            found += [Import(path, node.lineno, alias.name) for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}:{node.lineno}: imports are absolute"
            assert node.module is not None
            if node.module == "overfly":
                found += [Import(path, node.lineno, f"overfly.{alias.name}") for alias in node.names]
            else:
                found.append(Import(path, node.lineno, node.module))
    return found


ALL_IMPORTS = [found for path in MODULES for found in imports_of(path)]


def own(found: Import) -> str | None:
    """The part of the house that is imported, or None for other packages."""
    words = found.module.split(".")
    return words[1] if words[0] == "overfly" and len(words) > 1 else None


def listed(wrong: list[Import]) -> str:
    return "\n".join(str(found) for found in wrong)


def test_there_is_a_house() -> None:
    assert len(MODULES) > 50
    assert len(ALL_IMPORTS) > 200


@pytest.mark.parametrize("part", MAY_IMPORT)
def test_imports_point_one_way(part: str) -> None:
    allowed = MAY_IMPORT[part]
    assert allowed is not None
    wrong = [
        found
        for found in ALL_IMPORTS
        if part_of(found.file) == part and (to := own(found)) is not None and to != part and to not in allowed
    ]
    assert not wrong, listed(wrong)


def test_only_the_command_line_knows_the_command_line() -> None:
    wrong = [
        found
        for found in ALL_IMPORTS
        if own(found) == "cli" and part_of(found.file) not in ("cli", "__main__")
    ]
    assert not wrong, listed(wrong)


def test_only_the_command_line_and_pipelines_know_the_simulator_and_the_viewer() -> None:
    wrong = [
        found
        for found in ALL_IMPORTS
        if own(found) in ("simulation", "viewer")
        and part_of(found.file) not in ("cli", "pipeline", "simulation", "viewer")
    ]
    assert not wrong, listed(wrong)


def test_nothing_but_pipelines_and_above_imports_pipelines() -> None:
    wrong = [
        found
        for found in ALL_IMPORTS
        if own(found) == "pipeline" and part_of(found.file) not in ("cli", "pipeline", "__init__")
    ]
    assert not wrong, listed(wrong)


@pytest.mark.parametrize("part", NO_INPUT_OR_OUTPUT)
def test_the_heart_touches_no_files(part: str) -> None:
    wrong = [
        found
        for found in ALL_IMPORTS
        if part_of(found.file) == part and found.module.split(".")[0] in INPUT_AND_OUTPUT
    ]
    assert not wrong, listed(wrong)
    for path in MODULES:
        if part_of(path) == part:
            calls = [
                node
                for node in ast.walk(ast.parse(path.read_text(encoding="utf-8")))
                if isinstance(node, ast.Call)
                and isinstance(node.func, ast.Name)
                and node.func.id in ("open", "print")
            ]
            assert not calls, f"{path}:{calls[0].lineno} opens or prints"


def test_the_graph_touches_files_in_one_module() -> None:
    wrong = [
        found
        for found in ALL_IMPORTS
        if part_of(found.file) == "graph"
        and found.file.name != "files.py"
        and found.module.split(".")[0] in INPUT_AND_OUTPUT
    ]
    assert not wrong, listed(wrong)


def test_the_slam_loop_touches_no_files() -> None:
    online = (
        "slam",
        "locator",
        "mapper",
        "gaps",
        "bridging",
        "sighting",
        "window",
        "start",
        "visual_map",
        "scale",
    )
    for name in online:
        path = SOURCE / f"{name}.py"
        if path.exists():
            wrong = [f for f in imports_of(path) if f.module.split(".")[0] in INPUT_AND_OUTPUT]
            wrong += [
                f for f in imports_of(path) if own(f) in ("pipeline", "cli", "sensors", "products", "files")
            ]
            assert not wrong, listed(wrong)


def test_sql_is_known_in_one_place() -> None:
    wrong = [f for f in ALL_IMPORTS if f.module == "sqlite3" and part_of(f.file) != "mapstore"]
    assert not wrong, listed(wrong)


def test_truth_is_read_only_where_it_is_compared() -> None:
    """Files of truth are named groundtruth or truth: no other part may even know the words in a path."""
    names = re.compile(
        r"""["'][^"']*(groundtruth|truth/|/truth|landmarks_gt|dsm_truth)[^"']*["']""", re.IGNORECASE
    )
    for path in MODULES:
        if path.name in COMPARE_WITH_TRUTH:
            continue
        if part_of(path) in BLIND_TO_TRUTH or (path.parent == SOURCE and path.name != "evaluation.py"):
            for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
                if isinstance(node, ast.Constant) and isinstance(node.value, str) and "\n" not in node.value:
                    assert not names.search(repr(node.value)), f"{path}:{node.lineno} names a file of truth"


@pytest.mark.parametrize("path", MODULES, ids=lambda path: str(path.relative_to(SOURCE)))
def test_modules_are_short_and_say_what_they_are(path: Path) -> None:
    text = path.read_text(encoding="utf-8")
    assert len(text.splitlines()) <= LONGEST_FILE
    if text.strip():
        docstring = ast.get_docstring(ast.parse(text))
        if path.name != "__init__.py":
            assert docstring, "a module says in its first line what it is"


def texts() -> list[Path]:
    """Everything of the project that people read."""
    folders = ("src", "tests", "docs", "examples", "benchmarks")
    suffixes = {".py", ".md", ".toml", ".yaml", ".yml", ".html", ".js"}
    found = [path for folder in folders for path in (ROOT / folder).rglob("*") if path.suffix in suffixes]
    found += [path for path in ROOT.glob("*") if path.suffix in suffixes]
    return [path for path in found if path != Path(__file__)]


def test_no_text_knows_the_machine_it_was_written_on() -> None:
    absolute = re.compile(r"(?<![\w.])/(work|home|Users|root|tmp/brief)/")
    wrong = []
    for path in texts():
        for number, line in enumerate(path.read_text(encoding="utf-8").splitlines(), start=1):
            if absolute.search(line):
                wrong.append(f"{path.relative_to(ROOT)}:{number}: {line.strip()}")
    assert not wrong, "\n".join(wrong)


def test_code_explains_itself_without_numbers_of_issues() -> None:
    ticket = re.compile(
        r"\b(issue|ticket|PR|pull request) ?#\d+|\bTODO\b|\bFIXME\b|\bXXX\b|\bin this session\b"
    )
    wrong = []
    for path in texts():
        if path.suffix == ".py":
            for number, line in enumerate(path.read_text(encoding="utf-8").splitlines(), start=1):
                if ticket.search(line):
                    wrong.append(f"{path.relative_to(ROOT)}:{number}: {line.strip()}")
    assert not wrong, "\n".join(wrong)


def test_failures_are_raised_not_swallowed() -> None:
    """No bare except, no exit() in the middle of the house, no print outside the command line."""
    wrong = []
    for path in MODULES:
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.ExceptHandler) and node.type is None:
                wrong.append(f"{path.relative_to(ROOT)}:{node.lineno} catches everything")
            if isinstance(node, ast.Call) and isinstance(node.func, ast.Name):
                if node.func.id in ("exit", "quit"):
                    wrong.append(f"{path.relative_to(ROOT)}:{node.lineno} exits")
                if node.func.id == "print" and part_of(path) not in ("cli", "__main__"):
                    wrong.append(f"{path.relative_to(ROOT)}:{node.lineno} prints")
    assert not wrong, "\n".join(wrong)


def test_the_errors_are_one_tree() -> None:
    from overfly import errors

    classes = [value for value in vars(errors).values() if isinstance(value, type)]
    assert len(classes) > 5
    for kind in classes:
        assert issubclass(kind, errors.OverflyError)
        assert kind.__name__ in (errors.__doc__ or ""), f"{kind.__name__} is not drawn in the tree"
        assert kind.exit_code == (2 if issubclass(kind, errors.UsageError) else 1)
