"""House rules that a reader of the code relies on, looked up in its syntax trees."""

from __future__ import annotations

import ast
import re
import subprocess
import sys
from functools import cache
from importlib.metadata import version
from pathlib import Path

import mitsuba_fspt as fspt
from mitsuba_fspt.runtime import errors

PACKAGE = Path(fspt.__file__).parent
FILES = sorted(PACKAGE.rglob("*.py"))
NAMES = [str(path.relative_to(PACKAGE)) for path in FILES]

# The rooms of the house and which others each may import; no two import each other.
ARROWS = {
    "runtime": set(),
    "optics": {"runtime"},
    "images": {"runtime", "optics"},
    "phantom": {"runtime", "optics"},
    "tissue": {"runtime", "optics", "phantom"},
    "jit": set(),
    "camera": {"runtime", "optics", "jit"},
    "emission": {"runtime", "optics", "jit"},
    "integral": {"runtime", "phantom", "jit", "camera", "emission"},
    "plugins": {"runtime", "optics", "images", "jit", "camera", "emission", "integral"},
    "rendering": {"runtime", "optics", "images", "jit", "camera", "emission", "integral"},
    "detector": {"runtime", "optics", "images", "rendering"},
    "validation": {"runtime", "optics", "jit", "camera", "emission", "integral", "rendering"},
    "studies": {"runtime", "images", "jit", "camera", "emission", "integral", "rendering", "validation"},
    "inverse": {
        "runtime",
        "optics",
        "images",
        "detector",
        "phantom",
        "tissue",
        "jit",
        "camera",
        "emission",
        "integral",
        "rendering",
    },
    "viewer": {"runtime", "optics", "images", "rendering"},
    "cli": {
        "runtime",
        "optics",
        "images",
        "detector",
        "phantom",
        "tissue",
        "camera",
        "rendering",
        "studies",
        "inverse",
        "validation",
        "viewer",
    },
}
# The rooms inside `integral` and which others of them each may import. All may import the files beside them that are
# listed; no room imports the other files there, which join the rooms.
ARROWS_OF_INTEGRAL = {"lines": set(), "pupil": {"lines"}, "surface": {"lines"}, "rows": {"lines", "pupil", "surface"}}
FOR_ALL_OF_INTEGRAL = {"estimator", "progress", "quadrature", "shortcuts", "solution"}
# Only these import `validation`: no result depends on it.
IMPORTS_VALIDATION = {"cli", "studies/converge", "validation"}
# Rooms of Dr.Jit code. Others import the renderer inside functions alone, and only these do.
DRJIT_ROOMS = {"jit", "camera", "emission", "integral", "plugins"}
IMPORTS_MITSUBA = {"runtime", "rendering", "validation", "studies", "inverse"}
PUBLIC = [
    "Calibration",
    "Comparison",
    "Convergence",
    "Detector",
    "Exposure",
    "FsptError",
    "Image",
    "Inversion",
    "Location",
    "Phantom",
    "TransportMatrix",
    "calibrate",
    "camera_from_opencv",
    "compare",
    "converge",
    "derivatives",
    "explain",
    "import_flux",
    "invert",
    "load",
    "locate",
    "read",
    "read_transport",
    "render",
    "scene_xml",
    "sweep",
    "transport",
    "view",
]


@cache
def tree_of(name):
    return ast.parse((PACKAGE / name).read_text())


@cache
def nodes_of(name):
    """All nodes of a file, which the rules go through one after the other."""
    return list(ast.walk(tree_of(name)))


def room_of(name):
    """First folder of a file; '' for those at the top."""
    return name.split("/")[0] if "/" in name else ""


def at_run_time(tree, outside_of=()):
    """All nodes but those under `if TYPE_CHECKING:` and those of some kinds with all in them."""
    todo = [tree]
    while todo:
        node = todo.pop()
        if isinstance(node, outside_of):
            continue
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


def imported_rooms(name):
    """Rooms that a file imports from, those for types alone included."""
    folder = name.split("/")[:-1]
    for node in nodes_of(name):
        if isinstance(node, ast.ImportFrom) and node.level:
            home = folder[: len(folder) - node.level + 1] + (node.module.split(".") if node.module else [])
            if home:
                yield home[0]
            else:
                yield from (alias.name for alias in node.names if alias.name in ARROWS)


def faults(find):
    """Every (file, what is found in it) of a rule that yields what breaks it."""
    return [f"{name}: {found}" for name in NAMES for found in find(name)]


def test_arrows_between_rooms_run_one_way():
    """No room imports another one than those listed; the list itself has no circle."""
    wrong = faults(
        lambda name: set(imported_rooms(name)) - ARROWS[room_of(name)] - {room_of(name)} if room_of(name) else ()
    )
    assert not wrong
    rooms = list(ARROWS)
    assert all(rooms.index(below) < rooms.index(room) for room, others in ARROWS.items() for below in others)
    assert {room_of(name) for name in NAMES} - {""} == set(ARROWS)


def imported_files(name):
    """Files of the package that a file imports from, inside functions and for types alone included."""
    folder = name.split("/")[:-1]
    for node in nodes_of(name):
        if isinstance(node, ast.ImportFrom) and node.level:
            home = folder[: len(folder) - node.level + 1] + (node.module.split(".") if node.module else [])
            for alias in node.names:
                tried = [
                    "/".join([*home, alias.name]) + ".py",
                    "/".join(home) + ".py",
                    "/".join([*home, "__init__.py"]),
                ]
                yield from [file for file in tried if file in NAMES][:1]


def test_no_files_import_each_other():
    """No circle of files, also not by imports inside functions or for types alone.

    Files are left out as long as there are some whose imports all lead to files left out before, or that only such
    files import: what remains are circles and what lies between two of them.
    """
    below = {name: set(imported_files(name)) - {name} for name in NAMES}
    while True:
        above = {other for others in below.values() for other in others}
        left = {name: below[name] & below.keys() for name in below if name in above and below[name] & below.keys()}
        if left == below:
            break
        below = left
    assert not below


def test_every_listed_arrow_exists():
    found = {(room_of(name), other) for name in NAMES for other in imported_rooms(name)}
    assert {(room, other) for room, others in ARROWS.items() for other in others} <= found


def files_imported(name):
    """Files of the package that a file imports from, as paths without suffix, those for types alone included."""
    folder = name.split("/")[:-1]
    for node in nodes_of(name):
        if isinstance(node, ast.ImportFrom) and node.level:
            home = [*folder[: len(folder) - node.level + 1], *(node.module.split(".") if node.module else [])]
            found = ["/".join(home), *("/".join([*home, alias.name]) for alias in node.names)]
            yield from (file for file in found if f"{file}.py" in NAMES)


def test_arrows_between_the_rooms_of_the_integral_run_one_way():
    """And no files of it import each other in a circle."""
    files = [name for name in NAMES if room_of(name) == "integral" and not name.endswith("__init__.py")]
    above = {name[:-3]: {file for file in files_imported(name) if room_of(file) == "integral"} for name in files}
    found = set()
    for file, others in above.items():
        _, *room, _ = file.split("/")
        for other in others if room else ():
            _, *below, stem = other.split("/")
            assert below or stem in FOR_ALL_OF_INTEGRAL, f"{file} imports {other}"
            found |= {(*room, *below)} if below not in ([], room) else set()
    listed = {(room, other) for room, others in ARROWS_OF_INTEGRAL.items() for other in others}
    assert found == listed
    assert {name.split("/")[1] for name in files if name.count("/") > 1} == set(ARROWS_OF_INTEGRAL)
    assert not circles(above)


def circles(above):
    """Files that import each other in a circle, and files that import those."""
    left = dict(above)
    while leaves := [file for file, others in left.items() if not others & set(left)]:
        for file in leaves:
            del left[file]
    return sorted(left)


def test_only_some_import_the_validation():
    wrong = [name for name in NAMES if "validation" in imported_rooms(name)]
    assert not [name for name in wrong if not name.startswith(tuple(IMPORTS_VALIDATION))]


# The only files that ask a plugin for its camera or its emitting surface; everybody else takes those.
ASKS_PLUGINS = {"camera/of_sensor.py": {"camera"}, "emission/of_emitter.py": {"surface"}}
WITHOUT_PLUGINS = {"camera", "emission", "integral", "inverse"}


def members_of_plugins():
    """Public names of the lens's and the surface's class that are not Mitsuba's: methods and attributes of `self`."""
    found = set()
    for name, base in (("plugins/lens.py", "Sensor"), ("plugins/surface.py", "Emitter")):
        body = next(node for node in tree_of(name).body if isinstance(node, ast.ClassDef))
        found |= {node.name for node in body.body if isinstance(node, ast.FunctionDef)} - MITSUBAS[base]
        for node in ast.walk(body):
            if (
                isinstance(node, ast.Attribute)
                and ast.unparse(node.value) == "self"
                and isinstance(node.ctx, ast.Store)
            ):
                found.add(node.attr)
    return {name for name in found if not name.startswith(("_", "m_"))}


MITSUBAS = {
    "Sensor": {
        "traverse",
        "parameters_changed",
        "sample_ray",
        "sample_direction",
        "pdf_direction",
        "bbox",
        "to_string",
    },
    "Emitter": {
        *("traverse", "parameters_changed", "bbox", "to_string", "eval", "sample_position", "pdf_position"),
        *("sample_ray", "sample_direction", "pdf_direction", "eval_direction", "sample_wavelengths"),
    },
}


def test_lens_and_surface_are_shells_whose_members_nobody_uses_below():
    """What integral, inverse and emission need of a plugin is its `Camera` or `EmittingSurface`, taken in one place."""
    members = members_of_plugins()
    assert members == {"camera", "prepare_model", "surface"}
    for name in (name for name in NAMES if room_of(name) in WITHOUT_PLUGINS):
        for node in nodes_of(name):
            if isinstance(node, ast.Attribute) and node.attr in members:
                holder = ast.unparse(node.value).rpartition(".")[2]
                plugin = holder in ("sensor", "lens", "emitter") or holder.endswith("()")
                assert not plugin or node.attr in ASKS_PLUGINS.get(name, ()), f"{name}, line {node.lineno}"


def test_every_file_of_the_integral_cites_an_equation():
    """Of the paper or of docs/model.md, as `tests/test_docs.py` checks; folders' descriptions apart."""
    files = [name for name in NAMES if room_of(name) == "integral" and not name.endswith("__init__.py")]
    assert not [name for name in files if not re.search(r"Eq\. \d|\bM\.\d", (PACKAGE / name).read_text())]


def test_the_integral_calls_its_data_images():
    """A picture is a drawing (`images/picture.py`); the glossary bans the word for powers on pixels."""
    files = [name for name in NAMES if room_of(name) == "integral"]
    assert not [name for name in files if re.search(r"pictures?\b", (PACKAGE / name).read_text(), re.I)]


def test_no_star_imports():
    assert not faults(
        lambda name: (
            f"line {node.lineno}"
            for node in nodes_of(name)
            if isinstance(node, ast.ImportFrom) and any(alias.name == "*" for alias in node.names)
        )
    )


def test_only_some_rooms_import_the_renderer():
    """Under TYPE_CHECKING anyone may name its types."""
    for name in NAMES:
        if {"mitsuba", "drjit"} & set(imported(at_run_time(tree_of(name)))):
            assert room_of(name) in DRJIT_ROOMS | IMPORTS_MITSUBA, name


def test_nobody_imports_the_renderer_at_module_level():
    """A plain import of the package loads neither Dr.Jit nor Mitsuba."""
    functions = (ast.FunctionDef, ast.AsyncFunctionDef, ast.Lambda)
    # The sum over surface points is Dr.Jit code too, and is imported where it is needed.
    for name in (name for name in NAMES if room_of(name) not in DRJIT_ROOMS and "direct_summation" not in name):
        assert not {"mitsuba", "drjit"} & set(imported(at_run_time(tree_of(name), functions))), name


def test_only_the_command_line_prints():
    for name in (name for name in NAMES if room_of(name) != "cli"):
        for node in nodes_of(name):
            if isinstance(node, ast.Call):
                printer = ast.unparse(node.func)
                assert printer not in ("print", "typer.echo", "sys.stdout.write", "sys.stderr.write"), name


def test_input_is_not_checked_by_assert_nor_refused_by_a_bare_exception():
    for name in NAMES:
        for node in nodes_of(name):
            assert not isinstance(node, ast.Assert), f"{name}, line {node.lineno}"
            if isinstance(node, ast.Raise) and node.exc is not None:
                raised = node.exc.func if isinstance(node.exc, ast.Call) else node.exc
                assert ast.unparse(raised) not in ("Exception", "BaseException"), f"{name}, line {node.lineno}"


def test_nobody_uses_the_private_names_of_another_file():
    """Neither `from .other import _name` nor `other._name` of a module imported from the package."""
    stems = {Path(other).stem for other in NAMES}
    for name in NAMES:
        nodes = list(nodes_of(name))
        taken = [alias for node in nodes if isinstance(node, ast.ImportFrom) and node.level for alias in node.names]
        modules = {alias.asname or alias.name for alias in taken} & stems
        assert not [alias.name for alias in taken if alias.name.startswith("_")], name
        for node in nodes:
            if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name) and node.value.id in modules:
                assert not node.attr.startswith("_"), f"{name}, line {node.lineno}"


def test_plugins_load_nothing_in_their_constructors():
    """`mi.load_dict` there races with the other threads of Mitsuba's loader: see the tests of scenes."""
    for name in (name for name in NAMES if room_of(name) in DRJIT_ROOMS):
        for node in nodes_of(name):
            if isinstance(node, ast.Call):
                assert ast.unparse(node.func) not in ("mi.load_dict", "mi.load_file", "mi.load_string"), name


def test_files_and_functions_stay_short():
    """A file is one noun of up to some 500 lines."""
    for name in NAMES:
        assert len((PACKAGE / name).read_text().splitlines()) <= 520, name
        for node in nodes_of(name):
            if isinstance(node, ast.FunctionDef):
                assert node.end_lineno - node.lineno < 60, f"{name}: {node.name}, line {node.lineno}"


def test_the_public_list_is_this():
    assert sorted(fspt.__all__) == PUBLIC
    for name in PUBLIC:
        thing = getattr(fspt, name)
        assert callable(thing)
        assert thing.__doc__


def test_the_package_shows_its_public_names_and_its_version():
    """The version without any of Mitsuba, and an unknown name as an AttributeError."""
    assert sorted(dir(fspt)) == PUBLIC
    assert fspt.__version__ == version("mitsuba-fspt")
    assert not hasattr(fspt, "colour")
    program = (
        "import sys, mitsuba_fspt as f; f.__version__; sys.exit('mitsuba' in sys.modules or 'numpy' in sys.modules)"
    )
    assert subprocess.run([sys.executable, "-c", program], cwd=PACKAGE.parent, check=False).returncode == 0


def test_every_error_is_ours_and_an_error_of_values():
    kinds = [kind for kind in vars(errors).values() if isinstance(kind, type) and kind.__module__ == errors.__name__]
    assert len(kinds) >= 8
    for kind in kinds:
        assert issubclass(kind, errors.FsptError)
        assert issubclass(kind, ValueError)
        assert kind.__doc__


def test_the_package_is_typed():
    assert (PACKAGE / "py.typed").is_file()
