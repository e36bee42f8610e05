"""Bad input: by the API an error of its class, by the command line exit code 2, one line, nothing left behind."""

from __future__ import annotations

import os
import re
import resource
import struct

import numpy as np
import pytest
from small_scenes import BALL_XML, LENS_XML, write_ply, write_scene

import mitsuba_fspt as fspt
from mitsuba_fspt.cli import app
from mitsuba_fspt.images import image
from mitsuba_fspt.runtime.errors import ExitanceError, FsptError, ImageError, OpticsError, SceneError

SQUARE = [(0, -3, -3), (0, 3, -3), (0, 3, 3), (0, -3, 3)]
FACES = [(0, 1, 2), (0, 2, 3)]


def lens(old="", new=""):
    """The lens with one thing put otherwise."""
    assert old in LENS_XML
    return {"sensor": LENS_XML.replace(old, new)}


def with_number(name, value):
    return lens("<transform", f'<float name="{name}" value="{value}"/><transform')


def with_model(name):
    return lens("<transform", f'<string name="model" value="{name}"/><transform')


def focus(tag):
    return lens('<float name="magnification" value="0.5"/>', tag)


def of_ball(old, new):
    assert old in BALL_XML
    return {"shapes": BALL_XML.replace(old, new)}


def integral(tag):
    return {"integrator": f'<integrator type="fspt_integral">{tag}</integrator>'}


def law(tag):
    return of_ball("<float", f'<string name="emission" value="fresnel"/>{tag}<float')


BLACKBODY = '<texture type="blackbody" name="exitance"><float name="temperature" value="5000"/></texture>'


def mesh(name, kind="vertex"):
    return {
        "shapes": f"""
    <shape type="ply" id="mouse"><string name="filename" value="{name}"/><boolean name="face_normals" value="true"/>
        <emitter type="fspt_surface"><texture type="mesh_attribute" name="exitance">
            <string name="name" value="{kind}_exitance"/></texture></emitter></shape>"""
    }


def write_meshes(folder):
    write_ply(folder / "negative.ply", SQUARE, FACES, vertex=[1, 1, -2, 1])
    write_ply(folder / "negative_face.ply", SQUARE, FACES, face=[1, -2])
    write_ply(folder / "plain.ply", SQUARE, FACES)
    write_ply(folder / "point.ply", [(1, 1, 1)] * 4, FACES, vertex=[1] * 4)
    write_ply(folder / "line.ply", [(0, 0, z) for z in range(4)], FACES, vertex=[1] * 4)
    write_ply(folder / "no_faces.ply", SQUARE, [], vertex=[1] * 4)
    write_ply(folder / "empty.ply", [], [], vertex=[])
    (folder / "words.ply").write_text("no mesh at all\n")
    (folder / "cut.ply").write_text("\n".join((folder / "plain.ply").read_text().splitlines()[:11]))
    # NaN has no spelling in an ASCII PLY.
    for name, bad in (("nan.ply", 3), ("nan_vertex.ply", 0), ("inf.ply", 3)):
        vertices = np.array([(*p, 1) for p in SQUARE], "<f4")
        vertices[2, bad] = np.inf if name == "inf.ply" else np.nan
        properties = "".join(f"property float {p}\n" for p in ("x", "y", "z", "exitance_x"))
        header = f"ply\nformat binary_little_endian 1.0\nelement vertex 4\n{properties}"
        header += "element face 2\nproperty list uchar int vertex_indices\nend_header\n"
        faces = b"".join(struct.pack("<B3i", 3, *face) for face in FACES)
        (folder / name).write_bytes(header.encode() + vertices.tobytes() + faces)


LENSES = {
    "u below F": (
        focus('<float name="focus_distance" value="40"/>'),
        "'focus_distance' must be > focal_length = 55 mm",
    ),
    "u equal to F": (focus('<float name="focus_distance" value="55"/>'), "'focus_distance' must be > focal_length"),
    "v below F": (focus('<float name="image_distance" value="50"/>'), "'image_distance' must be > focal_length"),
    "no focus": (focus(""), "'image_distance' sets the focus, got none"),
    "two focuses": (with_number("focus_distance", 165), "got 'focus_distance' and 'magnification'"),
    "f_number 0": (lens("$f_number", "0"), "'f_number' must be > 0 and finite, got 0"),
    "f_number negative": (lens("$f_number", "-2.8"), "'f_number' must be > 0 and finite, got -2.8"),
    "f_number nan": (lens("$f_number", "nan"), "'f_number' must be > 0 and finite, got nan"),
    "f_number missing": (lens('<float name="f_number" value="$f_number"/>', ""), "'f_number' is missing"),
    "focal_length 0": (lens('value="55"', 'value="0"'), "'focal_length' must be > 0"),
    "small lens": (with_number("lens_diameter", 3), "'lens_diameter' = 3 mm is smaller than the diaphragm D"),
    "image stop 0": (with_number("image_stop_diameter", 0), "'image_stop_diameter' must be > 0 and finite, got 0"),
    "image stop nan": (with_number("image_stop_diameter", "nan"), "'image_stop_diameter' must be > 0 and finite"),
    "pitch 0": (lens('value="0.8"', 'value="0"'), "'pixel_pitch' must be > 0 and finite, got 0"),
    "pitch negative": (lens('value="0.8"', 'value="-0.8"'), "'pixel_pitch' must be > 0 and finite, got -0.8"),
    "pitch in words": (
        lens('<float name="pixel_pitch" value="0.8"/>', '<string name="pixel_pitch" value="big"/>'),
        "'pixel_pitch' must be a number, got 'big'",
    ),
    "unknown model": (with_model("zoom"), "'model' must be one of diaphragm, hrrt, pinhole, ripoll, got 'zoom'"),
    "hrrt without a border": (with_model("hrrt"), "needs 'lens_diameter'"),
    "ripoll without its cone": (with_model("ripoll"), "needs 'numerical_aperture' in"),
    "a distance that is true": (
        lens("<transform", '<boolean name="diaphragm_distance" value="true"/><transform'),
        "'diaphragm_distance' must be a number, got True",
    ),
    "a camera that scales": (lens("<lookat", '<scale value="2"/><lookat'), "'to_world' scales lengths"),
}

SURFACES = {
    "negative": (
        of_ball("1e-3", "-1e-3"),
        "'exitance' of shape 'sphere' must be >= 0 W/mm², its lowest value is -0.001",
    ),
    "nan": (of_ball("1e-3", "nan"), "'exitance' of shape 'sphere' has NaN or infinite values"),
    "infinite": (of_ball("1e-3", "inf"), "has NaN or infinite values"),
    "true": (
        of_ball('<float name="exitance" value="1e-3"/>', '<boolean name="exitance" value="true"/>'),
        "'exitance' must be a number or a texture, got True",
    ),
    "placed by itself": (
        of_ball(
            '<float name="exitance"', '<transform name="to_world"><scale value="2"/></transform><float name="exitance"'
        ),
        "fspt_surface: 'to_world' has no meaning, light comes from the shape. Give it to that.",
    ),
    "an index in words": (law('<string name="int_ior" value="water"/>'), "'int_ior' must be a number, got 'water'"),
    "missing": (of_ball('<float name="exitance" value="1e-3"/>', ""), "'exitance' is missing"),
    "a vertex negative": (
        mesh("negative.ply"),
        "'exitance' of shape 'mouse' must be >= 0 W/mm², its lowest value is -2",
    ),
    "a face negative": (mesh("negative_face.ply", "face"), "its lowest value is -2"),
    "a vertex nan": (mesh("nan.ply"), "'exitance' of shape 'mouse' has NaN or infinite values"),
    "a vertex infinite": (mesh("inf.ply"), "has NaN or infinite values"),
    "no such attribute": (mesh("plain.ply"), "shape 'mouse' has no mesh attribute 'vertex_exitance'. In a PLY name"),
    "attribute on the faces": (mesh("negative_face.ply"), "has no mesh attribute 'vertex_exitance'"),
    "mesh of one point": (mesh("point.ply"), "shape 'mouse' has no area to glow"),
    "mesh on a line": (mesh("line.ply"), "shape 'mouse' has no area to glow"),
}

FILES = {
    "another camera": ({"sensor": '<sensor type="perspective"/>'}, "Use a sensor of type 'fspt_lens'"),
    "no camera": ({"sensor": ""}, "sensor 0 does not exist, the scene has 0"),
    "camera inside": (of_ball('value="3"', 'value="300"'), "the lens stands inside the phantom"),
    "nothing glows": ({"shapes": '<shape type="sphere"/>'}, "nothing glows"),
    "nothing there": ({"shapes": ""}, "nothing glows"),
    "a colour": (
        of_ball('<float name="exitance" value="1e-3"/>', '<rgb name="exitance" value="1, 2, 3"/>'),
        "'exitance' of an fspt_surface is a colour, J_n is one number",
    ),
    "a spectrum by its plugin": (
        of_ball('<float name="exitance" value="1e-3"/>', BLACKBODY),
        "'exitance' of an fspt_surface is a spectrum, J_n is one number",
    ),
    "a spectrum": (
        of_ball('<float name="exitance" value="1e-3"/>', '<spectrum name="exitance" value="400:1, 700:2"/>'),
        "'exitance' of an fspt_surface is a spectrum, J_n is one number",
    ),
    "a Monte Carlo that hides what glows": (
        {"integrator": '<integrator type="path"><boolean name="hide_emitters" value="true"/></integrator>'},
        "integrator PathIntegrator with 'hide_emitters' = true leaves out what surfaces send straight to the lens",
    ),
    "a Monte Carlo of no depth": (
        {"integrator": '<integrator type="ptracer"><integer name="max_depth" value="0"/></integrator>'},
        "integrator ParticleTracerIntegrator with 'max_depth' = 0 leaves out what surfaces send",
    ),
    "a glow without a shape": (
        {"more": '<emitter type="fspt_surface"><float name="exitance" value="1"/></emitter>'},
        "s.xml: an fspt_surface stands in <scene>. Put it into the <shape> that glows.",
    ),
    "no mesh file": (mesh("gone.ply"), '"gone.ply": file not found'),
    "words for a mesh": (mesh("words.ply"), '"words.ply": invalid PLY header'),
    "half a mesh": (mesh("cut.ply"), "cut.ply' ends early: its header tells of 4 vertex lines, there are 2"),
    "mesh without faces": (mesh("no_faces.ply"), "cannot load the shape 'ply'"),
    "empty mesh": (mesh("empty.ply"), "cannot load the shape 'ply'"),
    "a vertex that is nowhere": (mesh("nan_vertex.ply"), "mesh contains invalid vertex position data"),
    "unknown lens parameter": (with_number("fnumber", 3), "'fspt_lens' has no parameter fnumber. Correct its name"),
    "unknown surface parameter": (
        of_ball('<float name="exitance"', '<float name="excitance" value="1"/><float name="exitance"'),
        "'fspt_surface' has no parameter excitance",
    ),
    "unknown integral parameter": (
        integral('<float name="rtoll" value="1"/>'),
        "'fspt_integral' has no parameter rtoll",
    ),
    "a limit that is none here": (
        integral('<integer name="max_depth" value="1"/>'),
        "fspt_integral: 'max_depth' has no meaning, light goes straight to the lens",
    ),
    "emitters to hide": (integral('<boolean name="hide_emitters" value="true"/>'), "'hide_emitters' has no meaning"),
    "rtol in words": (
        integral('<string name="rtol" value="fine"/>'),
        "fspt_integral: 'rtol' must be a number, got 'fine'",
    ),
    "a part of a line of sight": (
        integral('<float name="max_nodes" value="100.7"/>'),
        "'max_nodes' must be a whole number, got 100.7",
    ),
    "lines of sight that are true": (
        integral('<boolean name="max_nodes" value="true"/>'),
        "'max_nodes' must be a whole number, got True",
    ),
    "shortcuts in words": (
        integral('<string name="shortcuts" value="no"/>'),
        "fspt_integral: 'shortcuts' must be true or false, got 'no'. Give it as a boolean.",
    ),
    "an integrator in another": (
        integral('<integrator type="path"/>'),
        "'fspt_integral' has no use for what stands in it without a name",
    ),
    "unknown plugin": ({"integrator": '<integrator type="fspt_integrall"/>'}, 'Plugin "fspt_integrall" not found'),
    "rtol in the file": (integral('<float name="rtol" value="-1"/>'), "'rtol' must be in (0, 1), got -1"),
    "domain in the file": (integral('<string name="domain" value="x"/>'), "'domain' must be one of pupil, surface"),
    "a number in words": (lens('value="0.8"', 'value="big"'), 'could not parse floating point value "big"'),
    "a parameter without a value": (lens("$f_number", "$aperture"), "undefined parameter: $aperture"),
    "a bitmap of nothing": (
        of_ball('<float name="exitance" value="1e-3"/>', '<texture type="bitmap" name="exitance"/>'),
        "s.xml: a texture 'bitmap' has no 'filename'. Give it one.",
    ),
    "a number twice": (
        integral('<float name="rtol" value="1e-2"/><float name="rtol" value="1e-3"/>'),
        "s.xml: 'fspt_integral' has 'rtol' more than once. Leave it there once.",
    ),
    "two bodies of one name": (
        {"shapes": 2 * BALL_XML.replace("<shape", '<shape name="ball"')},
        "s.xml: 'scene' has 'ball' more than once",
    ),
    "a rotation about an axis of another length": (
        of_ball("<emitter", '<transform name="to_world"><rotate x="1" y="2" z="2" angle="77"/></transform><emitter'),
        "s.xml: the axis 1 2 2 of a <rotate> must have the length 1, got 3: Mitsuba stretches what it turns. Give "
        'x="0.333333", y="0.666667", z="0.666667".',
    ),
    "a rotation about an axis that is no number": (
        of_ball("<emitter", '<transform name="to_world"><rotate x="nan" angle="77"/></transform><emitter'),
        "s.xml: the axis nan 0 0 of a <rotate> must have the length 1, got nan",
    ),
    "a rotation about no axis": (
        of_ball("<emitter", '<transform name="to_world"><rotate value="0, 0, 0" angle="77"/></transform><emitter'),
        "s.xml: the axis 0 0 0 of a <rotate> must have the length 1, got 0",
    ),
    "a tag that is none": ({"more": '<lense type="fspt_lens"/>'}, "lense"),
}

SCENES = {
    f"{kind.__name__}: {name}": (parts, kind, message)
    for kind, table in ((OpticsError, LENSES), (ExitanceError, SURFACES), (SceneError, FILES))
    for name, (parts, message) in table.items()
}


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("bad")
    write_meshes(folder)
    return folder


@pytest.fixture
def refused(folder, capfd, monkeypatch):
    """The one line on stderr of a call that must end with exit code 2 and leave the folder as it was."""
    monkeypatch.chdir(folder)

    def refused(*arguments):
        before = {name: os.path.getmtime(name) for name in os.listdir()}
        capfd.readouterr()
        code = app.run([str(argument) for argument in arguments])
        out, err = capfd.readouterr()
        assert code == 2, err
        assert re.fullmatch(r"fspt: [^\n]+\n", err)
        assert out == ""
        assert {name: os.path.getmtime(name) for name in os.listdir()} == before
        return err

    return refused


@pytest.mark.parametrize("name", SCENES)
def test_scenes_that_cannot_be(folder, refused, name):
    parts, kind, message = SCENES[name]
    write_scene(folder / "s.xml", **parts)
    err = refused("render", "s.xml", "-o", "o.exr")
    assert message in err
    with pytest.raises(FsptError) as raised:
        fspt.render(fspt.load("s.xml"))
    assert message in str(raised.value)
    assert "\n" not in str(raised.value)
    if kind is ExitanceError:
        assert message in refused("render", "s.xml", "--method", "path", "--spp", "2", "-o", "o.exr")
    # Mitsuba's loader passes on text, no class: what it refuses, with the place in the file, is a SceneError.
    assert isinstance(raised.value, SceneError if "(line " in err else kind)


# --- the command line itself ---

RENDER = ("render", "s.xml")
MONTE_CARLO = (*RENDER, "--method", "path")
EXPOSE = ("expose", "gone.exr", "-o", "e.exr", "--exposure-time", "1", "--wavelength-nm", "600")
COMMANDS = {
    "unknown parameter": ((*RENDER, "-D", "iso=100"), "no parameter 'iso'. Its <default> parameters: f_number, dist"),
    "parameter without =": ((*RENDER, "-D", "f_number"), "-D f_number: must be NAME=VALUE"),
    "parameter without name": ((*RENDER, "-D", "=8"), "-D =8: must be NAME=VALUE"),
    "parameter without value": ((*RENDER, "-D", "f_number="), "-D f_number=: must be NAME=VALUE"),
    "parameter twice": (
        (*RENDER, "-D", "f_number=4", "-D", "f_number=8"),
        "f_number is 4 already",
    ),
    "parameter out of range": ((*RENDER, "-D", "f_number=1e-300"), "'f_number' must be in 1/1e+30"),
    "parameter in words": (
        (*RENDER, "-D", "f_number=wide"),
        "s.xml: parameter 'f_number' must be a finite number, got 'wide'. Correct this value.",
    ),
    "parameter with its unit": ((*RENDER, "-D", "f_number=8mm"), "'f_number' must be a finite number, got '8mm'"),
    "place in words": ((*RENDER, "-D", "distance=far"), "'distance' must be a finite number, got 'far'"),
    "place nowhere": ((*RENDER, "-D", "distance=nan"), "'distance' must be a finite number, got 'nan'"),
    "pixels and a half": (
        ("render", "given.xml", "-D", "width=8.5"),
        "parameter 'width' must be a whole number, got '8.5'",
    ),
    "neither true nor false": (
        ("render", "given.xml", "-D", "quick=yes"),
        "parameter 'quick' must be true or false, got 'yes'",
    ),
    "angle nowhere": (("render", "given.xml", "-D", "view=inf"), "'view' must be a finite number, got 'inf'"),
    "half a place": (("render", "given.xml", "-D", "at=0,0,O"), "'at' must be a finite number, got '0,0,O'"),
    "parameter that cannot be": ((*RENDER, "-D", "f_number=0"), "'f_number' must be > 0 and finite, got 0"),
    "no such folder": ((*RENDER, "-o", "gone/o.exr"), "the folder 'gone' does not exist"),
    "another format": ((*RENDER, "-o", "o.png"), "must end in .exr"),
    "the scene's own texture": (("render", "textured.xml"), "-o would overwrite 'textured.exr', which is needed too"),
    "the scene's own texture, as PNG": (
        ("render", "textured.xml", "-o", "map.exr", "--png"),
        "-o would overwrite 'map.png', which is needed too",
    ),
    "a scene of depths": (("render", "depth.xml", "-o", "o.exr"), "integrator DepthIntegrator gives no power"),
    "a file for a folder": ((*RENDER, "-o", "s.xml/o.exr"), "'s.xml' is a file, not a folder. Give another place"),
    "a folder for a file": ((*RENDER, "-o", "folder.exr"), "'folder.exr' is a folder"),
    "rtol 0": ((*RENDER, "--rtol", "0"), "'rtol' must be in (0, 1), got 0"),
    "rtol negative": ((*RENDER, "--rtol", "-1"), "'rtol' must be in (0, 1), got -1"),
    "rtol nan": ((*RENDER, "--rtol", "nan"), "'rtol' must be in (0, 1), got nan"),
    "rtol in words": ((*RENDER, "--rtol", "fine"), "Invalid value for '--rtol'"),
    "domain unknown": ((*RENDER, "--domain", "film"), "'domain' must be one of pupil, surface, got 'film'"),
    "domain for path": ((*MONTE_CARLO, "--domain", "surface"), "'domain' = surface has no meaning for Monte Carlo"),
    "rtol for path": ((*MONTE_CARLO, "--rtol", "1e-3"), "'rtol' = 0.001 has no meaning for Monte Carlo"),
    "spp 0": ((*MONTE_CARLO, "--spp", "0"), "'spp' must be >= 2 for a standard error, got 0"),
    "spp negative": ((*MONTE_CARLO, "--spp", "-3"), "'spp' must be >= 2 for a standard error, got -3"),
    "spp broken": ((*MONTE_CARLO, "--spp", "1.5"), "Invalid value for '--spp'"),
    "spp for the integral": ((*RENDER, "--spp", "4"), "'spp' = 4 has no meaning for integral"),
    "seed negative": ((*MONTE_CARLO, "--seed", "-1"), "'seed' must be in 0"),
    "seed too large": ((*MONTE_CARLO, "--seed", "99999999999"), "'seed' must be in 0"),
    "unknown method": ((*RENDER, "--method", "radiosity"), "'method' must be one of integral, path, ptracer, got"),
    "unknown option": ((*RENDER, "--fast"), "No such option: --fast"),
    "a second value": ((*RENDER, "--rtol", "1e-2", "--rtol", "1e-3"), "Option '--rtol' is given 2 times. Give it once"),
    "a second output of a group's verb": (
        ("scene", "new", "cylinder", "-o", "one.xml", "--output", "two.xml"),
        "Option '--output' is given 2 times. Give it once. See 'fspt scene new --help'.",
    ),
    "unknown verb": (("paint",), "No such command 'paint'"),
    "no scene named": (("render",), "Missing argument 'SCENE.xml|PHANTOM.ply'. See 'fspt render --help'."),
    "an image for a scene": (("render", "good.exr"), "good.exr: no scene, which is XML and begins with '<'. Give the"),
    "a phantom for a scene": (
        ("matrix", "plain.ply", "-o", "T.npz"),
        "Write one for this phantom by 'fspt scene new mouse --phantom plain.ply -o scene.xml'",
    ),
    "words for a phantom": (("render", "words.ply"), "'words.ply' is no PLY file, which begins with 'ply'. Give a"),
    "a folder for a mesh": (
        ("flux", "import", "folder.exr", "-o", "x.ply"),
        "mesh 'folder.exr' cannot be read: it is a folder",
    ),
    "a folder for an image": (("invert", "T.npz", "folder.exr", "-o", "x.ply"), "transport matrix 'T.npz' does not"),
    "photons without a wavelength": (
        (*RENDER, "--unit", "photons/s", "-D", "distance=400"),
        "photons need a wavelength, the image has none",
    ),
    "a comparison drawn elsewhere": (
        ("compare", "good.exr", "good.exr", "--png", "x.jpg"),
        "output file 'x.jpg' must end in .png",
    ),
    "no scene file": (("render", "gone.xml"), "gone.xml: cannot read the scene file"),
    "a folder for a scene": (("render", "folder.exr", "-o", "o.exr"), "folder.exr: cannot read the scene file"),
    "broken XML": (("render", "broken.xml"), "broken.xml: not valid XML: "),
    "not a scene": (("render", "bsdf.xml"), "bsdf.xml: the root is <diffuse>, a scene file has <scene>"),
    "no version": (("render", "old.xml"), "missing version attribute"),
    "an unknown encoding": (
        ("render", "klingon.xml"),
        "klingon.xml: unknown encoding: klingon. Save the scene file as UTF-8",
    ),
    "include of itself": (("render", "self.xml"), "self.xml: part.xml includes itself. Take that <include> out."),
    "expose: a seed beyond all": (
        ("expose", "good.exr", *EXPOSE[2:], "--seed", "99999999999999999999"),
        "detector: 'seed' must be finite and >= 0 and at most 2^53, for example 1, got 99999999999999999999",
    ),
    "include of nothing": (("render", "include.xml"), 'included file "gone.xml" not found'),
    "compare: no file": (("compare", "gone.exr", "gone.exr"), "image file 'gone.exr' does not exist"),
    "compare: no image": (("compare", "broken.xml", "broken.xml"), "must end in .exr, .fits, .h5, .npz or .tif"),
    "expose: no file": (EXPOSE, "image file 'gone.exr' does not exist"),
    "flux: no mesh": (("flux", "import", "gone.ply", "-o", "p.ply"), "mesh 'gone.ply' does not exist"),
    # Before any work, which for a tissue takes minutes: the description is not even read.
    "flux solve: another format": (("flux", "solve", "gone.toml", "-o", "p.vtk"), "must end in .ply"),
    "flux solve: a folder for a file": (("flux", "solve", "gone.toml", "-o", "folder.ply"), "'folder.ply' is a folder"),
    "flux solve: volume nowhere": (
        ("flux", "solve", "gone.toml", "-o", "p.ply", "--volume", "gone/f.vol"),
        "the folder 'gone' does not exist",
    ),
}


@pytest.fixture(scope="module")
def files(folder):
    """The files that are no scenes; a good one, `s.xml`, is written by each test."""
    for name in ("folder.exr", "folder.ply"):
        (folder / name).mkdir()
    (folder / "broken.xml").write_text('<scene version="3.0.0"><')
    (folder / "bsdf.xml").write_text('<bsdf version="3.0.0" type="diffuse"/>')
    (folder / "old.xml").write_text("<scene></scene>")
    textured = ("textured.exr", "map.png")
    for name in textured:
        (folder / name).write_text("a texture")
    textures = (f'<texture type="bitmap"><string name="filename" value="{n}"/></texture>' for n in textured)
    write_scene(folder / "textured.xml", more="".join(textures))
    given = """<default name="width" value="8"/><default name="quick" value="true"/><default name="view" value="0"/>
        <default name="at" value="0,0,0"/>"""
    turned = '<transform name="to_world"><rotate z="1" angle="$view"/><translate value="$at"/></transform><emitter'
    write_scene(
        folder / "given.xml",
        integrator='<integrator type="fspt_integral"><boolean name="shortcuts" value="$quick"/></integrator>',
        **lens('name="width" value="8"', 'name="width" value="$width"'),
        **of_ball("<emitter", turned),
        more=given,
    )
    write_scene(folder / "depth.xml", integrator='<integrator type="depth"/>')
    (folder / "klingon.xml").write_text('<?xml version="1.0" encoding="klingon"?><scene version="3.0.0"/>')
    for outer in ("self.xml", "part.xml"):
        (folder / outer).write_text('<scene version="3.0.0"><include filename="part.xml"/></scene>')
    fspt.Image(np.ones((2, 2))).write(folder / "good.exr")
    (folder / "include.xml").write_text('<scene version="3.0.0"><include filename="gone.xml"/></scene>')


@pytest.mark.parametrize("name", COMMANDS)
def test_commands_that_cannot_be(folder, files, refused, name):
    arguments, message = COMMANDS[name]
    write_scene(folder / "s.xml")
    assert message in refused(*arguments)


def test_a_folder_that_may_not_be_written_is_refused_before_the_work(folder, refused, monkeypatch):
    """Told by os.access, which root passes everywhere; the scene is not even looked at."""
    (folder / "locked.exr").touch()
    monkeypatch.setattr(os, "access", lambda path, mode: False)
    assert "is not writable. Write elsewhere with -o" in refused("render", "gone.xml", "-o", "o.exr")
    with pytest.raises(ImageError, match=r"locked\.exr' is write-protected"):
        fspt.Image(np.ones((2, 2))).write(folder / "locked.exr")


def test_a_disk_full_half_way_leaves_the_old_file_and_nothing_else(tmp_path, capfd, monkeypatch):
    """While an image is written, files may grow to 300 bytes, which no image fits into."""
    monkeypatch.chdir(tmp_path)
    write_scene(tmp_path / "s.xml")
    (tmp_path / "o.exr").write_bytes(b"the old one")
    write, (limit, hard) = image.write_planes, resource.getrlimit(resource.RLIMIT_FSIZE)

    def write_to_full_disk(*arguments):
        resource.setrlimit(resource.RLIMIT_FSIZE, (300, hard))  # Python ignores the signal
        try:
            write(*arguments)
        finally:
            resource.setrlimit(resource.RLIMIT_FSIZE, (limit, hard))

    monkeypatch.setattr(image, "write_planes", write_to_full_disk)
    code = app.run(["render", "s.xml", "-o", "o.exr"])
    out, err = capfd.readouterr()
    assert (code, out) == (2, "")
    assert re.fullmatch(r"fspt: image file 'o\.exr': [^\n]+\. Make room or give another place for it\.\n", err)
    assert sorted(os.listdir(tmp_path)) == ["o.exr", "s.xml"]
    assert (tmp_path / "o.exr").read_bytes() == b"the old one"


def test_names_of_files_are_no_images():
    with pytest.raises(ImageError, match=r"compare: must be given two images, got str\. Give what `read` returns\."):
        fspt.compare("a.exr", "b.exr")  # type: ignore[arg-type]


# --- odd, but not bad ---


def test_a_dark_image_is_written_and_reported_as_dark(tmp_path, capfd, monkeypatch):
    """A sphere that glows inwards: 0 W on every pixel, and on stderr what may be wrong; seen to be silent."""
    monkeypatch.chdir(tmp_path)
    inwards = BALL_XML.replace("<emitter", '<boolean name="flip_normals" value="true"/><emitter')
    write_scene(tmp_path / "s.xml", shapes=inwards)
    assert app.run(["render", "s.xml"]) == 0
    assert fspt.read("s.exr").power.max() == 0
    assert re.fullmatch(
        r"fspt: s\.exr: the picture is dark, no light reaches the lens\. Check [^\n]+ normals point outwards\.\n",
        capfd.readouterr().err,
    )


def test_a_glow_may_stand_outside_and_be_referred_to(tmp_path):
    glow = '<emitter type="fspt_surface" id="glow"><float name="exitance" value="1e-3"/></emitter>'
    body = '<shape type="sphere"><float name="radius" value="3"/><ref id="glow"/></shape>'
    image = fspt.render(write_scene(tmp_path / "s.xml", shapes=glow + body))
    assert image.power.max() > 0


def test_two_surfaces_and_faces_without_area_are_fine(folder, monkeypatch):
    monkeypatch.chdir(folder)
    write_ply(folder / "spike.ply", [*SQUARE, (0, 0, 0)], [*FACES, (4, 4, 4)], vertex=[1e-3] * 5)
    write_ply(folder / "square.ply", SQUARE, FACES, vertex=[1e-3] * 4)
    alone = fspt.render(write_scene(folder / "s.xml", **mesh("square.ply")), max_nodes=4)
    spiked = fspt.render(write_scene(folder / "s.xml", **mesh("spike.ply")), max_nodes=4)
    np.testing.assert_allclose(spiked.power, alone.power, atol=1e-6 * alone.power.max())
    both = mesh("square.ply")["shapes"] + BALL_XML
    together = fspt.render(write_scene(folder / "s.xml", shapes=both), max_nodes=4)
    assert together.power.sum() >= alone.power.sum() * (1 - 1e-6)
