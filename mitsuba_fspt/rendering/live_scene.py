"""A scene whose parameters change between images: in place where that is possible, else by loading it again."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ..images.image import Image
from ..runtime.errors import SceneError
from ..runtime.numbers import whole
from ..runtime.plugin_types import is_integral, is_lens, is_surface
from ..runtime.progress_bar import Progress
from .moved_shapes import Matrix, MovedShapes
from .parameters import parameter_texts
from .provenance import remember_defaults, source_of
from .render import integrator_of, render, sensor_of
from .scene import load, load_source, parsed
from .scene_source import SceneSource
from .scene_xml import TEXT, SceneXml, is_text

if TYPE_CHECKING:
    import mitsuba as mi

    from ..camera.camera import Camera

DRAFT = 0.03  # rtol of a draft, the quick image while a parameter moves
DRAFT_NODES = 16  # lines of sight of a pixel in a draft; silhouettes that need more are left to the full image
DRAFT_SAMPLES = 8  # samples of a pixel in a draft by Monte Carlo
RIGID = 1e-6  # largest deviation of a rotation's rows from orthonormality
Stamp = tuple[int, int] | None


@dataclass(frozen=True)
class SurfacePoint:
    """Surface point on the line of sight through the centres of a pixel and of the pupil.

    It is on the first surface that glows, or, if none does, on the last one that the line meets. The line continues
    through windows and off mirrors.

    position : [mm], in world coordinates
    shape : its id
    exitance : J_n [W/mm²]; None where the shape has no `fspt_surface`
    depth : distance from the lens plane along the optical axis [mm] at which the lens sees the point
    column, row, radius : centre and radius of the blur disc [pixels]; the middle of the first pixel is at (0.5, 0.5)
    by_way_of : ids of the windows and mirrors between lens and point, in the order in which the line meets them
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
    """Difference between the loaded scene and a requested one, if the loaded scene can be changed in place.

    lens : new numbers of the lens, by their names in the scene file
    placement : new `to_world` of the lens
    model : lens model in the scene file
    motions : motion of each shape from its position when it was loaded; None for a shape that does not move
    """

    lens: Mapping[str, float]
    placement: Matrix
    model: str
    motions: tuple[Matrix | None, ...] = ()

    @classmethod
    def of(cls, nodes: list[mi.parser.SceneNode], sensor: int, motions: tuple[Matrix | None, ...] = ()) -> Change:
        """Change that gives the lens the values in these elements, and the shapes these motions."""
        import mitsuba as mi

        lens = [node for node in nodes if node.type == mi.ObjectType.Sensor][sensor].props
        numbers = {name: float(lens[name]) for name in lens.keys() if lens.type(name) == mi.Properties.Type.Float}
        return cls(numbers, _matrix(lens), str(lens.get("model", "diaphragm")), motions)


@dataclass(frozen=True)
class Loaded:
    """A Mitsuba scene, the elements that it was loaded from, and the motion of its shapes since then.

    files : meshes and other files that the scene refers to, with time and size when it was loaded
    """

    scene: mi.Scene
    nodes: list[mi.parser.SceneNode]
    shapes: MovedShapes
    files: Mapping[Path, Stamp]

    def is_current(self) -> bool:
        """True as long as no file of data has changed."""
        return self.files == {file: _stamp(file) for file in self.files}

    def with_shapes_moved(self, change: Change, exact: bool) -> Change | None:
        """Move the shapes as `change` requires; return the remaining change of the lens, None if that is impossible.

        exact : the image must be the same, which it is only if no shape moves
        """
        still = (None,) * len(change.motions)
        if exact:
            return None if self.shapes.moved or any(motion is not None for motion in change.motions) else change
        if _all_alike(change.motions) and not _others_are_placed(self.nodes):
            placement = np.linalg.inv(change.motions[0]) @ change.placement  # type: ignore[arg-type]
            change = replace(change, placement=placement, motions=still)
        return change if self.shapes.move(change.motions) else None


class LiveScene:
    """A scene file or its text, with the Mitsuba scene for the last values of its parameters.

    A scene from `load` is replaced by the file or text that it was loaded from, with the values given then.

    Images are those of the sensor number `sensor`; with `any_sensor` it may be another one than an `fspt_lens`, and the
    scene is then loaded for every image. Numbers and pose of the lens are changed in place, without compilation. In
    drafts, shapes that make a rigid motion are moved in place, too, and a motion common to all shapes is replaced by
    the inverse motion of the lens; both give the same image but for rounding. Where the image must not differ, and for
    all other changes, those of referenced files included, the scene is loaded again. `loads` counts how often it was
    loaded.

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
        *,
        any_sensor: bool = False,
    ) -> None:
        parameters = parameters or {}
        source: Any = scene
        if not isinstance(scene, (str, os.PathLike)):
            source, before = _unchanged_source(scene)
            parameters = before | dict(parameters)
        self.source: str | os.PathLike[str] = source
        self.given = parameter_texts(parameters)
        self.sensor, self._any_sensor = whole("scene: 'sensor'", sensor, SceneError, "0"), any_sensor
        self.loads = 0
        self._loaded: Loaded | None = None

    @property
    def xml(self) -> SceneXml:
        """The XML with the given values, read again."""
        return SceneSource.of(self.source, self.given).xml

    def image(self, values: Mapping[str, object], model: str | None = None, progress: Progress | None = None) -> Image:
        """Image with these values of parameters and this lens `model`; None: the scene's own model.

        It is equal to the bit to that of `render` for a scene loaded with these values, except after a change of the
        pose of a lens that is tilted against the axes: its inverse rounds differently, by 1e-6 of the brightest pixel
        or less. `progress` as of `render`.
        Raises what `load` and `render` raise; afterwards the object can still be used.
        """
        image = render(self.scene(values, model), sensor=self.sensor, progress=progress)
        taken = self.given | parameter_texts(values)
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

        Spots that lines of sight may miss are not searched for. If the scene has another integrator, it is used with
        few samples, because the integral may leave out light of that scene. Parameters and errors as of `image`.
        """
        from ..camera.of_sensor import camera_of

        scene = self.scene(values, model, exact=False)
        lens = sensor_of(scene, self.sensor)
        integrator: Any = integrator_of(scene, None)
        if not is_integral(integrator):
            return render(scene, sensor=self.sensor, spp=DRAFT_SAMPLES)
        own = integrator.quadrature
        quadrature = replace(own, rtol=max(own.rtol, rtol), max_nodes=min(own.most_nodes, max_nodes))
        solution = integrator.solve(scene, lens, quadrature, narrow=False)
        how = {"method": "integral", "rtol": quadrature.rtol}
        return Image(solution.power, solution.error, solution.coverage, how | camera_of(lens).numbers())

    def surface_point(
        self, values: Mapping[str, object], model: str | None, column: int, row: int
    ) -> SurfacePoint | None:
        """Surface point seen in the middle of a pixel of the image; None if the line of sight meets no surface."""
        import drjit as dr
        import mitsuba as mi

        from ..camera.of_sensor import camera_of
        from ..emission.of_emitter import surface_of

        scene = self.scene(values, model)
        camera = camera_of(sensor_of(scene, self.sensor))
        offset: Any = mi.Vector2f(camera.film.crop_offset)  # the stubs add no vector to a point
        pixel = mi.Point2f(column + 0.5, row + 0.5) + offset
        dr.make_opaque(pixel)  # no new kernel for every pixel
        ray, cosine, _ = camera.line_of_sight(pixel, mi.Point2f(0, 0))
        met = _surfaces(scene, camera, ray, cosine)
        if not met:
            return None
        shapes = [shape for shape, _, _ in met]
        shape, si, depth = met[-1]
        surface = surface_of(shape.emitter())
        exitance = float(surface.exitance.eval(si)[0][0]) if surface else None
        centre, radius, _ = camera.blur_disc(ray(depth / cosine))  # type: ignore[arg-type]  # Float of the variant
        centre = camera.film_map.from_ideal(centre) - offset
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
        wanted = self.given | parameter_texts(values)
        source = SceneSource.of(self.source, wanted)
        nodes = parsed(source)
        now = self._loaded if self._loaded and self._loaded.is_current() else None
        change = _change(now.nodes, nodes, self.sensor) if now and is_lens(sensor_of(now.scene, self.sensor)) else None
        change = now.with_shapes_moved(change, exact) if now and change else None
        if now is None or change is None:
            self._loaded = now = None  # memory for one scene, not two
            self._loaded = now = self._load(source, nodes)
            change = Change.of(nodes, self.sensor)
        if is_lens(lens := sensor_of(now.scene, self.sensor)):
            _apply(change, lens, model)
        remember_defaults(now.scene, source.values)
        return now.scene

    def _load(self, source: SceneSource, nodes: list[mi.parser.SceneNode]) -> Loaded:
        """The scene of this source, of which it has these elements."""
        files = {file: _stamp(file) for file in source.files().difference(source.xml.files)}
        scene = load_source(source)
        self.loads += 1
        if not is_lens(sensor_of(scene, self.sensor)) and not self._any_sensor:
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
    scene: mi.Scene, camera: Camera, ray: mi.Ray3f, cosine: mi.Float
) -> list[tuple[mi.Shape, mi.SurfaceInteraction3f, mi.Float]]:
    """Shapes on a line of sight up to the first that glows, their points and the depths [mm] at which they are seen."""
    import drjit as dr
    import mitsuba as mi

    from ..integral.lines.courses import strongest_course
    from ..integral.lines.specular import Specular

    specular = Specular.of(scene, camera, even_if_none=True)
    found = []
    for si, depth in strongest_course(scene, specular, ray, cosine, mi.Float(0)):  # type: ignore[arg-type]
        shape = next(s for s in scene.shapes() if dr.all(si.shape == mi.ShapePtr(s)))
        found.append((shape, si, depth))
        if is_surface(shape.emitter()):
            break
    return found


def _change(old: list[mi.parser.SceneNode], new: list[mi.parser.SceneNode], sensor: int) -> Change | None:
    """Change that turns the scene of the elements `old` into that of `new`; None if it cannot be made in place.

    sensor : number of the lens
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
    """True if the properties have the same names and differ only in values of these kinds."""
    names = list(before.keys())
    if before.plugin_name() != after.plugin_name() or names != list(after.keys()):
        return False
    for name in names:
        if before.type(name) != after.type(name):
            return False
        if before.type(name) not in kinds and not _equal(before[name], after[name]):
            return False
    return True


def _equal(one: Any, other: Any) -> bool:
    """True if two values of properties are equal; references are equal if they refer to the same element."""
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
    """True if an element other than a shape or a sensor, such as an emitter or a volume, has its own `to_world`."""
    import mitsuba as mi

    moved = (mi.ObjectType.Shape, mi.ObjectType.Sensor)
    return any("to_world" in node.props for node in nodes if node.type not in moved)


def _matrix(props: mi.Properties) -> Matrix:
    """`to_world` of an element."""
    placed: Any = props["to_world"] if "to_world" in props else None
    return np.eye(4) if placed is None else np.array(placed.matrix, np.float64).reshape(4, 4)


def _apply(change: Change, lens: Any, model: str | None) -> None:
    """Give the fspt_lens its new numbers, placement and model; OpticsError for a lens that cannot exist."""
    import mitsuba as mi

    from ..camera.of_sensor import camera_of

    lens.prepare_model(model or change.model)
    parameters = mi.traverse(lens)
    for name, number in change.lens.items():
        if name in parameters:  # not the times of Mitsuba's shutter, which have no effect on an image
            parameters[name] = number
    parameters["to_world"] = mi.Transform4f(change.placement)  # type: ignore[arg-type]  # an array
    parameters.update()
    camera_of(lens)  # raises what the update refused


def _unchanged_source(scene: mi.Scene) -> tuple[Any, dict[str, object]]:
    """Source of a scene and the values given to `load`; SceneError if unknown, or if the scene was changed since."""
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


def _plain(value: Any) -> Any:
    """Value of a parameter of Mitsuba as NumPy compares it."""
    value = getattr(value, "matrix", value)
    return np.array(value) if hasattr(value, "shape") else value


def _name(source: str | os.PathLike[str]) -> str:
    """Name of the scene in messages and metadata."""
    return str(TEXT) if is_text(source) else os.fspath(source)
