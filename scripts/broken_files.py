"""Reading of damaged files: each must be read, or refused by an error of the package, in one line.

    python scripts/broken_files.py [--files 20000] [--seed 1] [--only image.exr,counts.fits] [--keep FOLDER]

A small valid file of every kind that the package reads is changed at random: bytes, numbers and ranges of it, or its
length; of an archive also a member, with the checksum made right again. A process of its own reads it. Prints a table
of how many files were read, were refused in one line, printed something else, raised another exception, took longer
than TIME_LIMIT, or ended the process. The last four are faults: their files stay in FOLDER, and the exit code is 1.
"""

from __future__ import annotations

import argparse
import io
import json
import os
import random
import re
import resource
import select
import subprocess
import sys
import tempfile
import time
import warnings
import zipfile
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from mitsuba_fspt.optics.light import Light
from mitsuba_fspt.runtime.backend import quiet_mitsuba

TIME_LIMIT = 90.0  # s for one file: most take 0.01 s, a scene with a vertex far away 4 s, ten times that under load
START_LIMIT = 120.0  # s for the start of the reading process, and for its first file
MEMORY = 6 << 30  # bytes of address space, of which LLVM reserves some three GiB
OUTCOMES = ("read", "refused", "printed", "raised", "hung", "crashed")
FAULTS = OUTCOMES[2:]
OWN_LINE = re.compile(rb"fspt: [^\n]*\n")
NUMBER = re.compile(rb"[-+]?\d+\.?\d*(?:[eE][-+]?\d+)?")
NUMBERS = (b"0", b"-1", b"1", b"nan", b"inf", b"1e999", b"-1e-300", b"2147483648", b"99999999999999999999", b"1e6", b"")
BYTES = (0x00, 0xFF, 0x7F, 0x80, 0x01, 0x20, 0x0A)
WORDS = (b"\xff\xff\xff\xff", b"\xff\xff\xff\x7f", b"\x00\x00\x00\x80", b"\x00\x00\x00\x00", b"\x00\x00\xc0\x7f")


@dataclass(frozen=True)
class Kind:
    """One kind of file.

    name : of the file, or of the folder, that is read
    make : function that writes a valid file of that name, and beside it what belongs to it; all of them are changed
    read : function that reads the file of this name as the verbs of the command line do
    """

    name: str
    make: Callable[[Path], None]
    read: Callable[[Path], object]


@dataclass
class Report:
    """Number of files by kind and outcome, and the faults: kind, seed, outcome and what was raised or printed."""

    counts: dict[str, Counter] = field(default_factory=dict)
    faults: list[tuple[str, str, str, str]] = field(default_factory=list)

    def add(self, kind: str, seed: str, outcome: str, detail: str) -> None:
        """Count one file."""
        self.counts.setdefault(kind, Counter())[outcome] += 1
        if outcome in FAULTS:
            self.faults.append((kind, seed, outcome, detail))

    def table(self) -> str:
        """Markdown table with a row for each kind."""
        rows = [("file", *OUTCOMES)]
        rows += [(kind, *(str(found[one]) for one in OUTCOMES)) for kind, found in self.counts.items()]
        total = sum(self.counts.values(), Counter())
        rows.append((f"{sum(total.values())} files", *(str(total[one]) for one in OUTCOMES)))
        lines = ["| " + " | ".join(row) + " |" for row in rows]
        return "\n".join([lines[0], "|---" * len(rows[0]) + "|", *lines[1:]])


def main() -> None:
    """Read damaged files of all kinds by turns; print the table and each fault."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--files", type=int, default=20_000)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--only", help="kinds, separated by commas")
    parser.add_argument("--keep", type=Path, default=Path("out/broken_files"))
    parser.add_argument("--max-seconds", type=float, default=3600.0, help="stop with fewer files after that")
    parser.add_argument("--reader", action="store_true", help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.reader:
        read_named_files()
        return
    known = kinds()
    chosen = [kind for kind in known if not arguments.only or kind.name in arguments.only.split(",")]
    with tempfile.TemporaryDirectory() as folder:
        report = tried(chosen, arguments.files, arguments.seed, Path(folder), arguments.keep, arguments.max_seconds)
    print(report.table())
    for kind, seed, outcome, detail in report.faults:
        print(f"{kind}, seed {seed}: {outcome}: {detail}")
    sys.exit(1 if report.faults else 0)


def tried(
    chosen: list[Kind], files: int, seed: int, folder: Path, keep: Path | None, max_seconds: float = float("inf")
) -> Report:
    """Report of so many damaged files of these kinds, by turns, each read by another process; `keep`: for faults."""
    end = time.monotonic() + max_seconds
    report = Report()
    valid = {kind.name: valid_files(kind, folder / f"valid-{number}") for number, kind in enumerate(chosen)}
    with Reader() as reader:
        for number in range(files):
            if time.monotonic() > end:
                break
            kind = chosen[number % len(chosen)]
            case = f"{seed}-{number}"
            home = folder / f"case-{number}"
            write_damaged(valid[kind.name], home, random.Random(case))
            outcome, detail = reader.outcome(kind.name, home / kind.name)
            report.add(kind.name, case, outcome, detail)
            move(home, keep / f"{kind.name}-{case}" if keep and outcome in FAULTS else None)
    return report


def valid_files(kind: Kind, folder: Path) -> dict[str, bytes]:
    """Contents of valid files of a kind, by their names relative to the folder; they are read once, as a check."""
    folder.mkdir()
    kind.make(folder / kind.name)
    kind.read(folder / kind.name)
    return {str(path.relative_to(folder)): path.read_bytes() for path in sorted(folder.rglob("*")) if path.is_file()}


def write_damaged(valid: dict[str, bytes], folder: Path, chance: random.Random) -> None:
    """Write the files into a new folder, one of them changed."""
    changed = chance.choice(sorted(valid))
    for name, content in valid.items():
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(damaged(content, chance) if name == changed else content)


def move(folder: Path, target: Path | None) -> None:
    """Move a folder to `target`, or remove it."""
    import shutil

    if target is None:
        shutil.rmtree(folder)
    else:
        shutil.rmtree(target, ignore_errors=True)
        target.parent.mkdir(parents=True, exist_ok=True)
        shutil.move(folder, target)


# ------------------------------------------------------------------ damage


def damaged(content: bytes, chance: random.Random) -> bytes:
    """Content with one to three changes; of an archive, in half of the cases, a member changed and the sums right."""
    if content.startswith(b"PK") and chance.random() < 0.5:
        return with_damaged_member(content, chance)
    for _ in range(chance.choice((1, 1, 2, 3))):
        content = chance.choice(CHANGES)(bytearray(content), chance)
    return content


def with_damaged_member(content: bytes, chance: random.Random) -> bytes:
    """The archive with one member changed, left out or under another name, and the checksums right."""
    with zipfile.ZipFile(io.BytesIO(content)) as file:
        members = {name: file.read(name) for name in file.namelist()}
    changed = chance.choice(sorted(members))
    what = chance.random()
    if what < 0.05:
        del members[changed]
    elif what < 0.1:
        members["other.npy"] = members.pop(changed)
    else:
        members[changed] = chance.choice(CHANGES)(bytearray(members[changed]), chance)
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w") as file:
        for name, data in members.items():
            file.writestr(name, data)
    return buffer.getvalue()


def place(content: bytearray, chance: random.Random) -> int:
    """Index of a byte, in half of the cases one of the first 300, where headers are."""
    return chance.randrange(max(1, min(len(content), 300) if chance.random() < 0.5 else len(content)))


def bytes_changed(content: bytearray, chance: random.Random) -> bytes:
    """One to eight bytes replaced, by chance or by a byte that often has a meaning."""
    for _ in range(chance.randint(1, 8)):
        at = place(content, chance)
        content[at : at + 1] = bytes([chance.choice(BYTES) if chance.random() < 0.5 else chance.randrange(256)])
    return bytes(content)


def word_changed(content: bytearray, chance: random.Random) -> bytes:
    """Four bytes replaced by an extreme number."""
    at = place(content, chance)
    content[at : at + 4] = chance.choice(WORDS)
    return bytes(content)


def number_changed(content: bytearray, chance: random.Random) -> bytes:
    """A number in the text replaced by an extreme one, by words or by nothing."""
    found = list(NUMBER.finditer(content))
    if not found:
        return bytes_changed(content, chance)
    one = chance.choice(found)
    content[one.start() : one.end()] = chance.choice(NUMBERS)
    return bytes(content)


def cut(content: bytearray, chance: random.Random) -> bytes:
    """The beginning."""
    return bytes(content[: place(content, chance)])


def range_removed(content: bytearray, chance: random.Random) -> bytes:
    """Up to 64 bytes left out."""
    at = place(content, chance)
    return bytes(content[:at] + content[at + chance.randint(1, 64) :])


def range_repeated(content: bytearray, chance: random.Random) -> bytes:
    """Up to 64 bytes twice, or put elsewhere."""
    at, length = place(content, chance), chance.randint(1, 64)
    to = at if chance.random() < 0.5 else place(content, chance)
    return bytes(content[:to] + content[at : at + length] + content[to:])


def line_removed(content: bytearray, chance: random.Random) -> bytes:
    """A line left out, or two lines exchanged."""
    lines = bytes(content).splitlines(keepends=True)
    if len(lines) < 2:
        return cut(content, chance)
    one, other = chance.randrange(len(lines)), chance.randrange(len(lines))
    if chance.random() < 0.5:
        del lines[one]
    else:
        lines[one], lines[other] = lines[other], lines[one]
    return b"".join(lines)


CHANGES = (bytes_changed, bytes_changed, word_changed, number_changed, cut, range_removed, range_repeated, line_removed)


# ------------------------------------------------------------------ the process that reads


class Reader:
    """A process that reads files, started again when it has ended or had to be killed. Use it in a `with`.

    command : of the process, which takes a line with a JSON list [kind, path] and answers with [outcome, detail]
    """

    def __init__(self, command: list[str] | None = None, limit: float = TIME_LIMIT) -> None:
        self.command = command or [sys.executable, __file__, "--reader"]
        self.limit = limit
        self.process: subprocess.Popen | None = None

    def __enter__(self) -> Reader:
        return self

    def __exit__(self, *_: object) -> None:
        self._end()

    def outcome(self, kind: str, path: Path) -> tuple[str, str]:
        """One of `OUTCOMES`, and what was raised or printed."""
        limit = self.limit
        if self.process is None:
            pipe = subprocess.PIPE
            self.process = subprocess.Popen(self.command, stdin=pipe, stdout=pipe, stderr=subprocess.DEVNULL)
            limit += START_LIMIT
        process = self.process
        try:
            process.stdin.write(json.dumps([kind, str(path)]).encode() + b"\n")
            process.stdin.flush()
        except BrokenPipeError:
            return self._crashed()
        if not select.select([process.stdout], [], [], limit)[0]:
            self._end()
            return "hung", f"no answer in {limit:g} s"
        line = process.stdout.readline()
        if not line:
            return self._crashed()
        outcome, detail = json.loads(line)
        return outcome, detail

    def _crashed(self) -> tuple[str, str]:
        code = self.process.wait() if self.process else 0
        self._end()
        return "crashed", f"exit code {code}"

    def _end(self) -> None:
        if self.process is not None:
            self.process.kill()
            self.process.communicate()
            self.process = None


def read_named_files() -> None:
    """Read the files that lines on stdin name, and answer each on stdout."""
    answers = os.fdopen(os.dup(1), "wb", buffering=0)
    resource.setrlimit(resource.RLIMIT_AS, (MEMORY, MEMORY))
    readers = {kind.name: kind.read for kind in kinds()}
    quiet_mitsuba()  # as the command line does
    for line in sys.stdin:
        kind, path = json.loads(line)
        answers.write(json.dumps(outcome_of(readers[kind], Path(path))).encode() + b"\n")


def outcome_of(read: Callable[[Path], object], path: Path) -> tuple[str, str]:
    """Outcome of reading a file in this process: read, refused, printed or raised; and what was raised or printed."""
    from mitsuba_fspt.runtime.errors import FsptError

    outcome, detail = "read", ""
    with printed() as texts:
        try:
            read(path)
        except FsptError as error:
            outcome, detail = "refused", str(error)
            if "\n" in detail or not detail:
                outcome = "raised"
        except Exception as error:
            outcome, detail = "raised", f"{type(error).__name__}: {error}"
    if outcome != "raised" and (other := OWN_LINE.sub(b"", texts[0])):
        outcome, detail = "printed", other.decode("utf-8", "replace")
    return outcome, detail[:500]


@contextmanager
def printed() -> Iterator[list[bytes]]:
    """Context manager that yields a list, which after the block has what the process wrote to stdout and stderr."""
    texts: list[bytes] = []
    sys.stdout.flush()
    sys.stderr.flush()
    before = os.dup(1), os.dup(2)
    with tempfile.TemporaryFile() as file, warnings.catch_warnings():
        warnings.simplefilter("always")
        warnings.simplefilter("ignore", ResourceWarning)
        os.dup2(file.fileno(), 1)
        os.dup2(file.fileno(), 2)
        try:
            yield texts
        finally:
            sys.stdout.flush()
            sys.stderr.flush()
            for number, old in enumerate(before, 1):
                os.dup2(old, number)
                os.close(old)
            file.seek(0)
            texts.append(file.read())


# ------------------------------------------------------------------ kinds


def kinds() -> list[Kind]:
    """Every kind of file that the package reads."""
    meshes = ("ply", "obj", "off", "stl", "vtu", "vtk", "msh", "mesh", "inp", "xdmf")
    return [
        *(Kind(f"image.{suffix}", write_image, read_image) for suffix in ("exr", "tif", "npz", "h5", "fits")),
        Kind("electrons.exr", write_electrons, read_image),
        Kind("T.npz", write_matrix, read_matrix),
        Kind("phantom.ply", write_phantom, read_phantom),
        Kind("text.ply", write_text_ply, read_phantom),
        Kind("scene.xml", write_scene, read_scene),
        Kind("camera.toml", write_camera, read_camera),
        Kind("phantom.toml", write_description, read_description),
        *(Kind(f"counts.{suffix}", write_counts, read_counts) for suffix in ("tif", "fits", "npy")),
        Kind("click", write_click, read_counts),
        Kind("mask.tif", write_mask, read_mask),
        Kind("curve.csv", write_curve, read_curve),
        *(Kind(f"flux.{suffix}", write_mesh, read_mesh) for suffix in meshes),
        Kind("flux.npz", write_arrays, read_mesh),
        *(Kind(f"values.{suffix}", write_values, read_values) for suffix in ("csv", "npy", "npz", "mat")),
        Kind("nirfast.node", write_nirfast, read_mesh),
        Kind("node_run.dat", write_mmc, read_mesh),
    ]


CORNERS = np.array([(1, 0, 0), (-1, 0, 0), (0, 1, 0), (0, -1, 0), (0, 0, 1), (0, 0, -1)], np.float64) * 3  # mm
FACES = np.array([(0, 2, 4), (2, 1, 4), (1, 3, 4), (3, 0, 4), (2, 0, 5), (1, 2, 5), (3, 1, 5), (0, 3, 5)])
TETRAHEDRA = np.array([(0, 2, 4, 5), (2, 1, 4, 5), (1, 3, 4, 5), (3, 0, 4, 5)])  # that fill the octahedron
GLOW = np.linspace(1e-3, 2e-3, len(CORNERS))  # J_n of the corners [W/mm²]
LENS = {"focal_length": 50.0, "f_number": 1.8, "focus_distance": 150.0, "magnification": 0.5, "pixel_pitch": 0.1}
DETECTOR = {"quantum_efficiency": 0.9, "dark_current": 1e-3, "read_noise": 3.5, "full_well": 1e5, "gain": 1.6}


def an_image():
    """Image of 9 × 7 pixels with all planes, and the metadata of a rendered one."""
    import mitsuba_fspt as fspt

    power = np.linspace(0, 1e-9, 63, dtype=np.float32).reshape(7, 9)
    metadata = {"scene": "s.xml", "method": "integral", "rtol": 1e-3, "quantity": "power", "unit": "W", **LENS}
    return fspt.Image(power, power / 100, (power > 0).astype(np.float32), metadata, power > 9e-10)


def write_image(path: Path) -> None:
    an_image().write(path)


def write_electrons(path: Path) -> None:
    import mitsuba_fspt as fspt

    detector = fspt.Detector(**DETECTOR, bias=500, bits=16)
    detector.expose(an_image(), exposure_time=60, wavelength_nm=660, seed=1).write(path)


def read_image(path: Path) -> None:
    """As `fspt plot` reads it, with what `fspt roi` and `fspt compare` compute of an image."""
    import mitsuba_fspt as fspt
    from mitsuba_fspt.images.image import read_image_or_exposure
    from mitsuba_fspt.images.regions import measure

    image = read_image_or_exposure(path)
    if isinstance(image, fspt.Image):
        measure(image, "50%", Light.given(660))
        fspt.compare(image, image)


def write_matrix(path: Path) -> None:
    """A matrix of one view of 3 × 2 pixels and the octahedron, by hand."""
    from mitsuba_fspt.integral.rows.sparse_rows import SparseRows
    from mitsuba_fspt.inverse.transport_file import FORMAT
    from mitsuba_fspt.inverse.transport_matrix import TransportMatrix

    rows, columns = 6, len(CORNERS)
    values = np.linspace(0.1, 1.0, rows * columns, dtype=np.float32)
    block = SparseRows(
        (2, 3),
        columns,
        values,
        np.tile(np.arange(columns, dtype=np.int32), rows),
        np.arange(rows + 1) * columns,
        np.full(len(values), 1e-3, np.float16),
        np.full(rows, 1e-3, np.float32),
    )
    meta = {"format": FORMAT, "image_shape": [1, 2, 3], "views": [{"view": 0.0}], "on": "vertex", "columns": columns}
    meta |= {"parts": {"phantom": [0, columns]}, "lenses": [LENS], "mesh_digest": "0" * 64, "scene": "s.xml"}
    areas = np.full(columns, 6.0)
    TransportMatrix([block], meta, areas, values.reshape(rows, columns).sum(axis=0).astype(float)).save(path)


def read_matrix(path: Path) -> None:
    """Read, applied, transposed, and with its error."""
    import mitsuba_fspt as fspt

    matrix = fspt.read_transport(path)
    exitance = np.ones(matrix.shape[1])
    matrix.backward(matrix.forward(exitance))
    matrix.error(exitance)
    matrix.summary()


def write_phantom(path: Path) -> None:
    import mitsuba_fspt as fspt

    fspt.Phantom(CORNERS, FACES, GLOW, "vertex", {"source": "octahedron"}).write(path)


def write_text_ply(path: Path) -> None:
    lines = ["ply", "format ascii 1.0", "comment octahedron", f"element vertex {len(CORNERS)}"]
    lines += [f"property float {name}" for name in ("x", "y", "z", "exitance_x")]
    lines += [f"element face {len(FACES)}", "property list uchar int vertex_indices", "end_header"]
    lines += [f"{x:g} {y:g} {z:g} {glow:g}" for (x, y, z), glow in zip(CORNERS, GLOW, strict=True)]
    lines += [f"3 {a} {b} {c}" for a, b, c in FACES]
    path.write_text("\n".join(lines) + "\n")


def read_phantom(path: Path) -> None:
    """As `fspt render` reads it, with the picture, and as `fspt flux import` reads it."""
    import mitsuba_fspt as fspt

    fspt.render(fspt.load(fspt.scene_xml(path, width=8, height=8, pixel_pitch=1.0)), rtol=1e-2)
    fspt.import_flux(path)


def write_scene(path: Path) -> None:
    """The scene of the octahedron, with its mesh beside it."""
    import mitsuba_fspt as fspt

    mesh = path.with_name("phantom.ply")
    write_phantom(mesh)
    curve = path.with_name("curve.csv")
    write_curve(curve)
    film = {"width": 8, "height": 8, "pixel_pitch": 1.0}
    text = fspt.scene_xml(mesh, **film, wavelength_nm=660, transmittance_curve=str(curve))
    path.write_text(text.replace(f"{path.parent}/", ""), encoding="utf-8")


def read_scene(path: Path) -> None:
    """Loaded and rendered."""
    import mitsuba_fspt as fspt

    fspt.render(fspt.load(path), rtol=1e-2)


def write_camera(path: Path) -> None:
    lines = ["[detector]", *(f"{name} = {value}" for name, value in DETECTOR.items()), "bias = 500", "bits = 16"]
    lines += ["pixel_pitch = 0.013  # mm", "", "[lens]", "focal_length = 50", "f_number = 1.8", "pixel_pitch = 0.108"]
    lines += ["width = 256", 'model = "diaphragm"']
    path.write_text("\n".join(lines) + "\n")


def read_camera(path: Path) -> None:
    """Both tables, the lens before a phantom."""
    import mitsuba_fspt as fspt
    from mitsuba_fspt.phantom.framed_scene import camera_lens

    fspt.Detector.from_toml(path)
    mesh = path.with_name("octahedron.ply")
    write_phantom(mesh)
    fspt.scene_xml(mesh, **camera_lens(path))


DESCRIPTION = """\
[geometry]
shape = "cylinder"
radius = 15
height = 30
[optical]
mua = 0.0138
musp = 0.91
n = 1.37
a = "robin"
[[regions]]
shape = "sphere"
centre = [0, 0, 3]
radius = 4
mua = 0.02
musp = 1.5
[[sources]]
shape = "point"
centre = [8, 0, -1]
power = 1
[bands.red]
share = 0.4
mua = 0.01
musp = 0.8
[[bands.red.regions]]
mua = 0.02
musp = 1.2
[mesh]
edge = 1.5
order = 2
[output]
edge = 0.35
voxel = 0.4
"""


def write_description(path: Path) -> None:
    path.write_text(DESCRIPTION)


def read_description(path: Path) -> None:
    from mitsuba_fspt.tissue.phantom_file import PhantomFile

    PhantomFile.read(path)


def some_counts() -> np.ndarray:
    """Three frames of 7 × 9 counts [DN]."""
    return np.arange(189, dtype=np.uint16).reshape(3, 7, 9) + 700


def write_counts(path: Path) -> None:
    if path.suffix == ".npy":
        np.save(path, some_counts())
    elif path.suffix == ".fits":
        from astropy.io import fits

        header = fits.Header({"EXPTIME": 60.0, "XBINNING": 2, "YBINNING": 2, "ROWORDER": "BOTTOM-UP"})
        fits.PrimaryHDU(some_counts(), header).writeto(path)
    else:
        import tifffile

        tifffile.imwrite(path, some_counts(), photometric="minisblack")


def write_click(path: Path) -> None:
    """A click folder: counts, a bias frame, and a text about them."""
    import tifffile

    path.mkdir()
    tifffile.imwrite(path / "luminescent.TIF", some_counts()[0])
    tifffile.imwrite(path / "readbiasonly.TIF", some_counts()[1] - 200)
    text = "ClickNumber: X\n*** photograph: photograph.TIF\nExposure Time Sec: 0.2\nBinning Factor: 1\n"
    text += "*** luminescent image: luminescent.TIF\nExposure Time Sec: 60\nBinning Factor: 4\n"
    (path / "ClickInfo.txt").write_text(text)


def read_counts(path: Path) -> None:
    from mitsuba_fspt.detector.counts import read_counts as read

    read(path)


def write_mask(path: Path) -> None:
    import tifffile

    tifffile.imwrite(path, (np.arange(63).reshape(7, 9) % 2).astype(np.uint8))


def read_mask(path: Path) -> None:
    from mitsuba_fspt.images.regions import measure

    measure(an_image(), str(path), Light.given(660))


def write_curve(path: Path) -> None:
    path.write_text("wavelength [nm],transmittance\n500,0.1\n600,0.8  # edge\n700,0.9\n")


def read_curve(path: Path) -> None:
    from mitsuba_fspt.optics.transmittance import Curve

    Curve.read(path).at(660)


def write_mesh(path: Path) -> None:
    """The octahedron with J_n in a format of the suffix; those that hold no values go with a table of them."""
    import meshio
    import trimesh

    if path.suffix == ".ply":
        write_text_ply(path)
    elif path.suffix in (".obj", ".off", ".stl"):
        path.write_bytes(_bytes(trimesh.Trimesh(CORNERS, FACES, process=False).export(file_type=path.suffix[1:])))
        np.savetxt(path.with_name("values.txt"), GLOW if path.suffix != ".stl" else np.linspace(1e-3, 2e-3, len(FACES)))
    else:
        surface = path.suffix in (".vtk", ".xdmf")
        cells = [("triangle", FACES)] if surface else [("tetra", TETRAHEDRA)]
        values = {} if path.suffix in (".mesh", ".inp") else {"jn": GLOW}
        more = {"file_format": "gmsh", "binary": False} if path.suffix == ".msh" else {}
        with printed():
            meshio.write(path, meshio.Mesh(CORNERS, cells, point_data=values), **more)
        if more:  # meshio writes the values as NumPy 2 shows them, np.float64(0.001)
            path.write_text(re.sub(r"np\.float64\((.*?)\)", r"\1", path.read_text()))
        if not values:
            np.savetxt(path.with_name("values.txt"), GLOW)


def _bytes(content: str | bytes) -> bytes:
    return content.encode() if isinstance(content, str) else content


def write_arrays(path: Path) -> None:
    np.savez(path, vertices=CORNERS, faces=FACES, jn=GLOW)


def read_mesh(path: Path) -> None:
    """As `fspt flux import` reads it, with the table of values beside it if there is one."""
    import mitsuba_fspt as fspt

    values = path.with_name("values.txt")
    fspt.import_flux(path, values if values.exists() else None)


def write_values(path: Path) -> None:
    """J_n of the octahedron's corners in a file of their own."""
    if path.suffix == ".mat":
        from scipy.io import savemat

        savemat(path, {"data": {"phi": GLOW}})
    elif path.suffix == ".npy":
        np.save(path, GLOW)
    elif path.suffix == ".npz":
        np.savez(path, phi=GLOW)
    else:
        path.write_text("# corner; jn\n" + "".join(f"{k}; {glow:g}\n" for k, glow in enumerate(GLOW)))


def read_values(path: Path) -> None:
    import mitsuba_fspt as fspt

    fspt.import_flux((CORNERS, FACES), path, field="2" if path.suffix == ".csv" else None)


def write_nirfast(path: Path) -> None:
    np.savetxt(path, np.column_stack([np.ones(len(CORNERS)), CORNERS]), fmt="%g")
    np.savetxt(path.with_suffix(".elem"), TETRAHEDRA + 1, fmt="%d")
    path.with_suffix(".param").write_text("stnd\n" + "0.01 0.33 1.37\n" * len(CORNERS))
    np.savetxt(path.with_name("values.txt"), GLOW)


def write_mmc(path: Path) -> None:
    number = np.arange(1, 1 + len(CORNERS))
    np.savetxt(path, np.column_stack([number, CORNERS]), fmt="%g", header=f"1 {len(CORNERS)}", comments="")
    cells = np.column_stack([number[: len(TETRAHEDRA)], TETRAHEDRA + 1, np.ones(len(TETRAHEDRA))])
    np.savetxt(path.with_name("elem_run.dat"), cells, fmt="%d", header=f"1 {len(TETRAHEDRA)}", comments="")
    dref = np.column_stack([np.arange(1, 1 + len(FACES)), np.full(len(FACES), 0.01)])
    np.savetxt(path.with_name("values.txt"), dref, fmt="%g")


if __name__ == "__main__":
    main()
