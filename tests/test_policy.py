"""House rules that a reader of the code relies on, looked up in its syntax trees."""

from __future__ import annotations

import ast
from pathlib import Path

import pytest

import mitsuba_fspt as fspt
from mitsuba_fspt import errors

PACKAGE = Path(fspt.__file__).parent
FILES = sorted(PACKAGE.rglob("*.py"))
NAMES = [str(path.relative_to(PACKAGE)) for path in FILES]

# The rooms that know the renderer.
KNOWS_MITSUBA = {
    "backend.py",
    "scene.py",
    "rendering.py",
    "monte_carlo.py",
    "doctor.py",
    "sweep_studio.py",
    "converge_methods.py",
    "converge_reference.py",
    "converging.py",
    "stiff_cases_scenes.py",
}
PRINTS = {"cli.py", "flux_cli.py", "sweep_cli.py", "converge_cli.py"}
PUBLIC = [
    "Comparison",
    "Convergence",
    "Detector",
    "Exposure",
    "FsptError",
    "Image",
    "Phantom",
    "compare",
    "converge",
    "explain",
    "import_flux",
    "load",
    "read",
    "render",
    "sweep",
]


def tree_of(name):
    return ast.parse((PACKAGE / name).read_text())


def at_run_time(tree):
    """All nodes but those under `if TYPE_CHECKING:`."""
    todo = [tree]
    while todo:
        node = todo.pop()
        if isinstance(node, ast.If) and ast.unparse(node.test) in ("TYPE_CHECKING", "typing.TYPE_CHECKING"):
            todo += node.orelse
            continue
        yield node
        todo += ast.iter_child_nodes(node)


def imported(nodes):
    """First names of the absolute imports among the nodes."""
    for node in nodes:
        if isinstance(node, ast.Import):
            yield from (alias.name.split(".")[0] for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.level == 0:
            yield (node.module or "").split(".")[0]


@pytest.mark.parametrize("name", NAMES)
def test_no_star_imports(name):
    for node in ast.walk(tree_of(name)):
        assert not (isinstance(node, ast.ImportFrom) and any(alias.name == "*" for alias in node.names))


@pytest.mark.parametrize("name", NAMES)
def test_only_some_rooms_know_the_renderer(name):
    """Under TYPE_CHECKING anyone may name its types."""
    found = {"mitsuba", "drjit"} & set(imported(at_run_time(tree_of(name))))
    assert not found or name.startswith("plugins/") or name in KNOWS_MITSUBA


@pytest.mark.parametrize("name", [name for name in NAMES if not name.startswith("plugins/")])
def test_nobody_imports_the_renderer_at_module_level(name):
    """A plain import of the package loads neither Dr.Jit nor Mitsuba."""
    module = tree_of(name)
    functions = (ast.FunctionDef, ast.AsyncFunctionDef, ast.Lambda)
    inside = {id(n) for f in ast.walk(module) if isinstance(f, functions) for n in ast.walk(f)}
    outer = [node for node in at_run_time(module) if id(node) not in inside]
    assert not {"mitsuba", "drjit"} & set(imported(outer))


@pytest.mark.parametrize("name", [name for name in NAMES if name not in PRINTS])
def test_only_the_command_line_prints(name):
    for node in ast.walk(tree_of(name)):
        if isinstance(node, ast.Call):
            assert ast.unparse(node.func) not in ("print", "typer.echo", "sys.stdout.write", "sys.stderr.write")


@pytest.mark.parametrize("name", NAMES)
def test_input_is_not_checked_by_assert_nor_refused_by_a_bare_exception(name):
    for node in ast.walk(tree_of(name)):
        assert not isinstance(node, ast.Assert), f"line {node.lineno}"
        if isinstance(node, ast.Raise) and node.exc is not None:
            raised = node.exc.func if isinstance(node.exc, ast.Call) else node.exc
            assert ast.unparse(raised) not in ("Exception", "BaseException"), f"line {node.lineno}"


@pytest.mark.parametrize("name", [name for name in NAMES if name not in PRINTS | {"__main__.py"}])
def test_nothing_imports_the_command_line(name):
    for node in ast.walk(tree_of(name)):
        if isinstance(node, ast.ImportFrom) and node.level:
            assert (node.module or "").split(".")[-1] not in ("cli", "flux_cli", "sweep_cli", "converge_cli")
            assert not {alias.name for alias in node.names} & {"cli", "flux_cli", "sweep_cli", "converge_cli"}


@pytest.mark.parametrize("name", NAMES)
def test_nobody_uses_the_private_names_of_another_file(name):
    """Neither `from .other import _name` nor `other._name` of a module imported from the package."""
    nodes = list(ast.walk(tree_of(name)))
    taken = [alias for node in nodes if isinstance(node, ast.ImportFrom) and node.level for alias in node.names]
    modules = {alias.asname or alias.name for alias in taken} & {Path(other).stem for other in NAMES}
    assert not [alias.name for alias in taken if alias.name.startswith("_")]
    for node in nodes:
        if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name) and node.value.id in modules:
            assert not node.attr.startswith("_"), f"line {node.lineno}"


def test_plugins_load_nothing_in_their_constructors():
    """`mi.load_dict` there races with the other threads of Mitsuba's loader: see the tests of scenes."""
    for path in (PACKAGE / "plugins").glob("*.py"):
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.Call):
                assert ast.unparse(node.func) not in ("mi.load_dict", "mi.load_file", "mi.load_string"), path.name


@pytest.mark.parametrize("name", NAMES)
def test_files_stay_short(name):
    assert len((PACKAGE / name).read_text().splitlines()) <= 300


@pytest.mark.parametrize("name", NAMES)
def test_functions_stay_short(name):
    for node in ast.walk(tree_of(name)):
        if isinstance(node, ast.FunctionDef):
            assert node.end_lineno - node.lineno < 60, f"{node.name}, line {node.lineno}"


def test_the_public_list_is_this():
    assert sorted(fspt.__all__) == PUBLIC
    for name in PUBLIC:
        thing = getattr(fspt, name)
        assert callable(thing)
        assert thing.__doc__


def test_every_error_is_ours_and_an_error_of_values():
    kinds = [kind for kind in vars(errors).values() if isinstance(kind, type)]
    assert len(kinds) >= 8
    for kind in kinds:
        assert issubclass(kind, errors.FsptError)
        assert issubclass(kind, ValueError)
        assert kind.__doc__


def test_the_package_is_typed():
    assert (PACKAGE / "py.typed").is_file()
