"""A scene whose parameters change while one looks at it: in place where that is possible, loaded again elsewhere."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ..images.image import Image
from ..runtime.errors import SceneError
from ..runtime.plugin_types import is_integral, is_lens, is_surface
from ..runtime.progress_bar import Progress
from .moved_shapes import Matrix, MovedShapes
from .provenance import remember_defaults, source_of
from .render import integrator_of, render, sensor_of
from .scene import load, parameter_text, parsed, values_of
from .scene_xml import TEXT, SceneXml, is_text, read_text, read_xml

if TYPE_CHECKING:
    import mitsuba as mi

DRAFT = 0.03  # rtol of a picture while a parameter moves
DRAFT_NODES = 16  # lines of sight of a pixel in it: silhouettes beyond the accuracy of twelve wait for the full picture
DRAFT_SAMPLES = 8  # a pixel, of such a picture by Monte Carlo
RIGID = 1e-6  # by which the rows of a rotation may differ from orthonormal ones
Stamp = tuple[int, int] | None


@dataclass(frozen=True)
class SurfacePoint:
    """The surface on the line of sight through the centres of a pixel and of the pupil.

    It is the first one that glows, or else the last one that the line meets; windows and mirrors lead the line on.

    position : [mm], in world coordinates
    shape : its id
    exitance : J_n [W/mm²]; None where the shape has no `fspt_surface`
    depth : distance from the lens plane along the optical axis [mm] at which the point is seen
    column, row, radius : centre and radius of the blur disc [pixels of the image; 0.5, 0.5 is the middle of the first]
    by_way_of : ids of the windows and mirrors before it, in the order in which the line meets them
    """

    position: tuple[float, float, float]
    shape: str
    exitance: float | None
    depth: float
    column: float
    row: float
    radius: float
    by_way_of: tuple[str, ...] = ()


@dataclass(frozen=True)
class Change:
    """What differs between the loaded scene and a wanted one, if it can be changed in place.

    lens : new numbers of the lens, by their names in the scene file
    placement : new `to_world` of the lens
    model : of the lens in the scene file
    motions : of the shapes from where they were loaded; None for those that stay
    """

    lens: Mapping[str, float]
    placement: Matrix
    model: str
    motions: tuple[Matrix | None, ...] = ()

    @classmethod
    def of(cls, nodes: list[mi.parser.SceneNode], sensor: int, motions: tuple[Matrix | None, ...] = ()) -> Change:
        """Change to these elements, and these motions of their shapes."""
        import mitsuba as mi

        lens = [node for node in nodes if node.type == mi.ObjectType.Sensor][sensor].props
        numbers = {name: float(lens[name]) for name in lens.keys() if lens.type(name) == mi.Properties.Type.Float}
        return cls(numbers, _matrix(lens), str(lens.get("model", "diaphragm")), motions)


@dataclass(frozen=True)
class Loaded:
    """A Mitsuba scene, the elements that it was loaded from, and how its shapes have moved since.

    files : meshes and other data that the scene refers to, as they were when it was loaded
    """

    scene: mi.Scene
    nodes: list[mi.parser.SceneNode]
    shapes: MovedShapes
    files: Mapping[Path, Stamp]

    def is_current(self) -> bool:
        """True as long as no file of data has changed."""
        return self.files == {file: _stamp(file) for file in self.files}

    def taken(self, change: Change, exact: bool) -> Change | None:
        """The change of the lens that is left, once the shapes are where `change` wants them; None if they cannot be.

        `exact` : to the bit, as they are only where they were loaded
        """
        still = (None,) * len(change.motions)
        if exact:
            return None if self.shapes.moved or any(motion is not None for motion in change.motions) else change
        if _all_alike(change.motions) and not _others_are_placed(self.nodes):
            placement = np.linalg.inv(change.motions[0]) @ change.placement  # type: ignore[arg-type]
            change = replace(change, placement=placement, motions=still)
        return change if self.shapes.move(change.motions) else None


class LiveScene:
    """A scene file or its text, and the Mitsuba scene of the last values of its parameters.

    A scene that `load` has made stands for what it was loaded from, with the values given then.

    The picture is that of the sensor with the number `sensor`. Numbers and placement of that lens change in place,
    without compilation. For drafts, shapes that make a rigid motion are moved in place, too; a motion of all of them
    is replaced by the inverse motion of the lens. Both give the same picture but for rounding. Where that shall not be,
    and for all other changes, also of the files that it refers to, the scene is loaded again; `loads` counts that.

    Raises
    ------
    SceneError : the scene cannot be read or loaded, was changed after it was loaded, the sensor does not exist
        or is no `fspt_lens`.
    """

    def __init__(
        self,
        scene: mi.Scene | str | os.PathLike[str],
        parameters: Mapping[str, object] | None = None,
        sensor: int = 0,
    ) -> None:
        parameters = parameters or {}
        if not isinstance(scene, (str, os.PathLike)):
            scene, before = _unchanged_source(scene)
            parameters = before | dict(parameters)
        self.source: str | os.PathLike[str] = scene
        self.given = {name: parameter_text(value) for name, value in parameters.items()}
        self.sensor = sensor
        self.loads = 0
        self._loaded: Loaded | None = None

    @property
    def xml(self) -> SceneXml:
        """The XML with the given values, read again."""
        return self._read(self.given)

    def _read(self, values: Mapping[str, str]) -> SceneXml:
        """The XML with these values, read again."""
        return read_text(str(self.source), values) if is_text(self.source) else read_xml(Path(self.source), values)

    def image(self, values: Mapping[str, object], model: str | None = None, progress: Progress | None = None) -> Image:
        """Image with these values of parameters, and with another lens `model` than the scene's if it is given.

        The same bits as from `render` of a scene that is loaded with these values. `progress` as of `render`.

        Raises what `load` and `render` raise. The scene stays usable.
        """
        image = render(self.scene(values, model), sensor=self.sensor, progress=progress)
        taken = self.given | _texts(values)
        scene_id = " ".join([_name(self.source), *(f"{key}={text}" for key, text in taken.items())])
        return replace(image, metadata=image.metadata | {"scene": scene_id})

    def draft(
        self,
        values: Mapping[str, object],
        model: str | None = None,
        rtol: float = DRAFT,
        max_nodes: int = DRAFT_NODES,
    ) -> Image:
        """Quick image by the integral, to `rtol` or with `max_nodes` lines of sight on a pixel.

        Spots that lines of sight may miss are not searched for. Parameters as of `image`.

        Where the scene has another integrator, that takes few samples instead: the integral may leave out its light.
        A moved phantom is seen by the lens moved the other way. Raises as `image`.
        """
        scene = self.scene(values, model, exact=False)
        lens, integrator = sensor_of(scene, self.sensor), integrator_of(scene, None)
        if not is_integral(integrator):
            return render(scene, sensor=self.sensor, spp=DRAFT_SAMPLES)
        own = integrator.quadrature
        quadrature = replace(own, rtol=max(own.rtol, rtol), max_nodes=min(own.max_nodes, max_nodes))
        solution = integrator.solve(scene, lens, quadrature, narrow=False)
        how = {"method": "integral", "rtol": quadrature.rtol}
        return Image(solution.power, solution.error, solution.coverage, how | lens.numbers())

    def surface_point(
        self, values: Mapping[str, object], model: str | None, column: int, row: int
    ) -> SurfacePoint | None:
        """Surface point under the middle of a pixel of the image; None where the line of sight meets nothing."""
        import drjit as dr
        import mitsuba as mi

        scene = self.scene(values, model)
        lens = sensor_of(scene, self.sensor)
        offset = mi.Vector2f(lens.film().crop_offset())
        pixel = mi.Point2f(column + 0.5, row + 0.5) + offset
        dr.make_opaque(pixel)  # no new kernel for every pixel
        ray, cosine, _ = lens.line_of_sight(pixel, mi.Point2f(0, 0))
        met = _surfaces(scene, lens, ray, cosine)
        if not met:
            return None
        shapes = [shape for shape, _, _ in met]
        shape, si, depth = met[-1]
        emitter = shape.emitter()
        exitance = float(emitter.exitance.eval(si)[0][0]) if is_surface(emitter) else None
        centre, radius, _ = lens.blur_disc(ray(depth / cosine))
        centre -= offset
        return SurfacePoint(
            tuple(float(c[0]) for c in si.p),  # type: ignore[arg-type]
            shape.id(),
            exitance,
            float(depth[0]),
            float(centre.x[0]),
            float(centre.y[0]),
            abs(float(radius[0])),
            tuple(shape.id() for shape in shapes[:-1]),
        )

    def scene(self, values: Mapping[str, object], model: str | None = None, *, exact: bool = True) -> mi.Scene:
        """The Mitsuba scene with these values of its parameters and this `model` of its lens (None: its own)."""
        wanted = self.given | _texts(values)
        nodes = parsed(self.source, **wanted)
        now = self._loaded if self._loaded and self._loaded.is_current() else None
        change = _change(now.nodes, nodes, self.sensor) if now else None
        change = now.taken(change, exact) if now and change else None
        if now is None or change is None:
            self._loaded = now = None  # memory for one scene, not two
            self._loaded = now = self._load(wanted, nodes)
            change = Change.of(nodes, self.sensor)
        _apply(change, sensor_of(now.scene, self.sensor), model)
        remember_defaults(now.scene, values_of(self.source, wanted))
        return now.scene

    def _load(self, wanted: Mapping[str, str], nodes: list[mi.parser.SceneNode]) -> Loaded:
        """The scene with these values of its parameters, of which it has these elements."""
        xml = self._read(wanted)
        files = {file: _stamp(file) for file in xml.sources().difference(xml.files)}
        scene = load(self.source, **wanted)
        self.loads += 1
        if not is_lens(sensor_of(scene, self.sensor)):
            raise SceneError(f"{_name(self.source)}: sensor {self.sensor} is no fspt_lens. Give one that is.")
        return Loaded(scene, nodes, MovedShapes(scene), files)


def _stamp(file: Path) -> Stamp:
    """Time of the last change [ns] and size [bytes] of a file; None if it is gone."""
    try:
        found = os.stat(file)
    except OSError:
        return None
    return found.st_mtime_ns, found.st_size


def _surfaces(
    scene: mi.Scene, lens: mi.Sensor, ray: mi.Ray3f, cosine: mi.Float
) -> list[tuple[mi.Shape, mi.SurfaceInteraction3f, mi.Float]]:
    """Shapes on a line of sight up to the first that glows, their points and the depths [mm] at which they are seen."""
    import drjit as dr
    import mitsuba as mi

    from ..integral.specular import Specular, strongest_course

    specular = Specular.of(scene, lens, even_if_none=True)
    found = []
    for si, depth in strongest_course(scene, specular, ray, cosine, mi.Float(0)):  # type: ignore[arg-type]
        shape = next(s for s in scene.shapes() if dr.all(si.shape == mi.ShapePtr(s)))
        found.append((shape, si, depth))
        if is_surface(shape.emitter()):
            break
    return found


def _change(old: list[mi.parser.SceneNode], new: list[mi.parser.SceneNode], sensor: int) -> Change | None:
    """Change of the lens, that with the number `sensor`, that makes the picture of the elements `old` that of `new`.

    None if there is none.
    """
    import mitsuba as mi

    if len(old) != len(new):
        return None
    motions: list[Matrix | None] = []  # of the shapes, None for those that are where they were
    for before, after in zip(old, new, strict=True):
        same = before.props == after.props
        if after.type == mi.ObjectType.Shape:
            motions.append(None if same else _motion(before.props, after.props))
            same = same or motions[-1] is not None
        elif after.type == mi.ObjectType.Sensor:
            same = same or _differ_in(before.props, after.props, mi.Properties.Type.Float, mi.Properties.Type.Transform)
        if not same:
            return None
    return Change.of(new, sensor, tuple(motions))


def _differ_in(before: mi.Properties, after: mi.Properties, *kinds: object) -> bool:
    """True if properties have the same names, and differ in values of these kinds alone."""
    names = list(before.keys())
    if before.plugin_name() != after.plugin_name() or names != list(after.keys()):
        return False
    for name in names:
        if before.type(name) != after.type(name):
            return False
        if before.type(name) not in kinds and not _equal(before[name], after[name]):
            return False
    return True


def _equal(one: object, other: object) -> bool:
    """Equality of values of properties; references by the element that they refer to."""
    import mitsuba as mi

    reference = mi.Properties.ResolvedReference if hasattr(mi.Properties, "ResolvedReference") else ()
    return one.index() == other.index() if isinstance(one, reference) else bool(np.all(one == other))


def _motion(before: mi.Properties, after: mi.Properties) -> Matrix | None:
    """Rigid motion that is the only difference between two shapes; None if it is not."""
    import mitsuba as mi

    if "to_world" not in before or not _differ_in(before, after, mi.Properties.Type.Transform):
        return None
    motion = _matrix(after) @ np.linalg.inv(_matrix(before))
    axes = motion[:3, :3]
    return motion if np.allclose(axes @ axes.T, np.eye(3), atol=RIGID) and np.linalg.det(axes) > 0 else None


def _all_alike(motions: tuple[Matrix | None, ...]) -> bool:
    """True if all shapes make the same motion."""
    first = motions[0] if motions else None
    return first is not None and all(motion is not None and np.allclose(motion, first) for motion in motions)


def _others_are_placed(nodes: list[mi.parser.SceneNode]) -> bool:
    """True if an element that is no shape and no sensor, as an emitter or a volume, has a place of its own."""
    import mitsuba as mi

    moved = (mi.ObjectType.Shape, mi.ObjectType.Sensor)
    return any("to_world" in node.props for node in nodes if node.type not in moved)


def _matrix(props: mi.Properties) -> Matrix:
    """`to_world` of an element."""
    return np.array(props["to_world"].matrix, np.float64).reshape(4, 4) if "to_world" in props else np.eye(4)


def _apply(change: Change, lens: mi.Sensor, model: str | None) -> None:
    """Give the lens its new numbers, placement and model; OpticsError for a lens that cannot exist."""
    import mitsuba as mi

    lens.prepare_model(model or change.model)
    parameters = mi.traverse(lens)
    for name, number in change.lens.items():
        parameters[name] = number
    parameters["to_world"] = mi.Transform4f(change.placement)
    parameters.update()
    if lens.fault:
        raise lens.fault


def _unchanged_source(scene: mi.Scene) -> tuple[Any, dict[str, object]]:
    """What a scene was loaded from; SceneError if that is not known, or if the scene was changed since."""
    import mitsuba as mi

    kept = source_of(scene) if isinstance(scene, mi.Scene) else None
    if kept is None:
        raise SceneError(
            f"scene: to change it, it must be a file, XML text or what `load` makes of these, got "
            f"{type(scene).__name__}. Give one."
        )
    source, given = kept
    now, then = mi.traverse(scene), mi.traverse(load(source, **given))
    for name, _ in now:
        if name not in then or not np.array_equal(_plain(now[name]), _plain(then[name])):
            raise SceneError(
                f"scene: '{name}' was changed after the scene was loaded, or its file was. Give the file's name."
            )
    return kept


def _plain(value: object) -> object:
    """Value of a parameter of Mitsuba as NumPy compares it."""
    value = getattr(value, "matrix", value)
    return np.array(value) if hasattr(value, "shape") else value


def _texts(values: Mapping[str, object]) -> dict[str, str]:
    return {name: parameter_text(value) for name, value in values.items()}


def _name(source: str | os.PathLike[str]) -> str:
    """What messages and metadata call the scene."""
    return str(TEXT) if is_text(source) else os.fspath(source)
