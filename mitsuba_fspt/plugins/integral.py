"""`fspt_integral`: the deterministic integrator of Eq. 9."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, replace
from functools import partial

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from ..emission.face_table import FaceTable, edition_of, mark_of, shape_number
from ..emission.gradients import emitters_with_gradients
from ..integral import interpolated, pupil_form, surface_form
from ..integral.eq9 import View
from ..integral.exitance_rows import Rows, kinds_of, sizes_of
from ..integral.interpolated import Blocks, blocks_of
from ..integral.left_out import LeftOut, light_left_out
from ..integral.narrow import NarrowLight, narrow_light, peak_of_points, points_on_surfaces
from ..integral.nested_bsdfs import check_followed
from ..integral.progress import Progress
from ..integral.quadrature import Quadrature
from ..integral.scene_checks import check_scene, check_surfaces_alone
from ..integral.scene_warnings import scene_warnings
from ..integral.shortcuts import SHORTCUTS, Finding
from ..integral.solution import Solution
from ..integral.specular import Specular
from ..integral.tiles import Mosaic
from ..integral.window import Boxes, Window, glowing_boxes, window_of
from ..jit.mesh_buffers import box_of, buffers
from ..jit.recording import recording
from ..jit.robust_tracing import robust_scene
from ..runtime.cached_value import CachedValue
from ..runtime.deadline import Deadline
from ..runtime.errors import SceneError, named
from ..runtime.plugin_types import is_surface

MEANINGLESS = ("max_depth", "rr_depth", "hide_emitters", "samples_per_pass", "timeout")
LEAST_DISPLACEMENT = 1e-3  # pixels: least displacement of lines of sight by float32 that is added to the error
NARROW = 0.1  # times rtol times the brightest pixel: pixels with more light of narrow spots take the surface form
UNCERTAINTY = 2.0  # largest ratio of that light and its estimate


class FsptIntegral(mi.ad.integrators.common.ADIntegrator):
    r"""
    .. _integrator-fspt_integral:

    Free-space transport integral (:monosp:`fspt_integral`)
    -------------------------------------------------------

    .. pluginparameters::

     * - rtol
       - |float|
       - Requested error of every pixel, relative to the brightest pixel (Default: 1e-3).
     * - domain
       - |string|
       - pupil: lines of sight from every pixel (Default). surface: the power of every surface element is distributed
         over the pixels that its blur disc covers. Both are forms of Eq. 9. The second one is always used for light
         from objects and spots thinner than half a pixel or half their blur disc, which lines of sight would miss.
     * - pixel
       - |string|
       - area: integrate over the pixel (Default). centre: the value at its centre times its area, as in the paper.
     * - max_nodes
       - |int|
       - Largest number of lines of sight per pixel (Default: 4194304), at least four. In domain surface it is the mean
         per pixel, at least 256 and at most 65536.
     * - max_specular
       - |int|
       - Largest number of specular surfaces (null, thin and solid glass, mirrors, masks) that a line of sight passes
         through or is reflected by (Default: 8). The light that is cut off there is contained in the error.
     * - shortcuts
       - |bool|
       - Omit computations that the scene does not need (Default: true). false gives the same power, within the
         requested error, in more time.

    Needs an `fspt_lens`. Deterministic: the same bits every run; sampler, samples per pixel and seed are not used.
    """

    def __init__(self, props: mi.Properties) -> None:
        _refuse_meaningless(props)
        super().__init__(props)
        self.quadrature = _quadrature_of(props)
        # Results for the last scene. A reference to the scene itself would be a cycle: this integrator is its child.
        self._lossless: list[object] = []  # marks of the emitters of a scene that loses no rays
        self._robust: RobustCopy | None = None
        self._window, self._narrow, self._faces, self._warnings, self._rows = (CachedValue() for _ in range(5))
        self._logged: set[str] = set()
        self._grid_of_blocks = CachedValue()

    def solve(
        self,
        scene: mi.Scene,
        sensor: mi.Sensor,
        quadrature: Quadrature | None = None,
        progress: Callable[[float], None] | None = None,
        *,
        narrow: bool = True,
        deadline: Deadline | None = None,
    ) -> Solution:
        """Power, error and coverage of the sensor's crop window, by `quadrature` or the integrator's own.

        A large film is solved in tiles; `progress` is called with the share done, 0 … 1, after every level of each
        tile. With `narrow` = False, objects and spots that lines of sight may miss are neither searched for nor
        contained in the error; that is meant for drafts of an image that is computed in full afterwards. After the
        `deadline` no pixel is refined further: its error is that of the level it has reached. Every pixel takes four
        lines of sight in any case.

        Raises
        ------
        SceneError, ExitanceError : as in `check_scene`, or the scene has an environment emitter, or the memory does not
            suffice for the film.
        """
        quadrature = quadrature or self.quadrature
        check_scene(scene, sensor)
        check_surfaces_alone(scene)
        check_followed(scene)
        with recording(), dr.suspend_grad():
            specular = Specular.of(scene, sensor, quadrature, even_if_none=not quadrature.takes("specular"))
            bending = specular.bending if specular else ()
            _refuse_bending(specular, quadrature)
            window = self._visible_window(scene, sensor, not quadrature.takes("outside"), bending)
            mosaic = Mosaic(window)
            if mosaic.tiles:
                traced = self._traced(scene, sensor)
                faces = self._faces_of(traced) if quadrature.takes("record") else None
                view = View.of(traced, sensor, window, faces, specular)
                self._fill(mosaic, view, quadrature, Progress(progress, deadline=deadline or Deadline()), narrow)
            # Smaller displacements are random.
            rounding = sensor.rounding if sensor.rounding >= LEAST_DISPLACEMENT else 0.0
            solution = mosaic.solution(quadrature.least_error, rounding)
        return replace(solution, findings=(_outside(window), *solution.findings))

    def light_left_out(
        self, scene: mi.Scene, sensor: mi.Sensor, quadrature: Quadrature | None = None
    ) -> LeftOut | None:
        """Light that Eq. 9 leaves out in a scene that `solve` can render; None if there can be none."""
        return light_left_out(scene, sensor, quadrature or self.quadrature)

    def _fill(
        self,
        mosaic: Mosaic,
        view: View,
        quadrature: Quadrature,
        progress: Progress,
        narrow: bool,
    ) -> None:
        """Solve all tiles. With several, their tolerance follows from a lower bound of the brightest pixel."""
        tiles, window = mosaic.tiles, mosaic.window
        least_peak, points = 0.0, None
        progress(0.0)
        if len(tiles) > 1 and narrow:
            points = points_on_surfaces(view.scene, view.lens, view.specular)
            least_peak = max(pupil_form.peak_of_few(view, window, quadrature), peak_of_points(points, window))
        for k, tile in enumerate(tiles):
            light = partial(self._narrow_light, view, tile)
            if points or not narrow:
                light = partial(narrow_light, points, tile)
            mosaic.put(tile, self._solve_tile(tile, view, quadrature, light, least_peak, progress.part(k, len(tiles))))

    def _solve_tile(
        self,
        window: Window,
        view: View,
        quadrature: Quadrature,
        narrow_light: Callable[[], NarrowLight],
        least_peak: float,
        progress: Progress,
    ) -> Solution:
        """Solution by the requested form of Eq. 9; pixels with light of narrow spots always take the surface form.

        least_peak : lower bound of the brightest pixel of all tiles [W/mm²/sr]
        """
        scene, lens, specular = view.scene, view.lens, view.specular
        # The surface form ignores the border of the image-plane stop: pixels that the border crosses take lines of
        # sight.
        inside, cut = window.field_stop(lens)
        everywhere = quadrature.domain == "surface"
        if everywhere and not cut.any():
            known = surface_form.solve(scene, lens, window, quadrature, None, least_peak, progress, specular)
            return _with_dark_coverage(known, view, window)
        blocks, why = self._blocks(view, window, quadrature)
        if blocks:
            if solution := self._by_blocks(view, blocks, quadrature, least_peak, progress):
                return solution
            why = "most blocks of pixels have an edge, or light too narrow for them"
        narrow = narrow_light()
        where, peak = inside, least_peak
        if not everywhere:
            where = inside & (narrow.on_pixels > NARROW * quadrature.rtol * max(narrow.brightest, least_peak))
            peak = max(narrow.brightest / 2, least_peak)
        if specular and specular.bending:  # the surface form contains only light that goes straight to the lens
            where = np.zeros(window.shape, bool)
        if where.any() and not progress.deadline.passed():
            known = surface_form.solve(scene, lens, window, quadrature, where, peak, progress.part(0, 2), specular)
            known = _with_dark_coverage(known, view, window)
            rest = pupil_form.solve(view, window, quadrature, narrow.in_focus, known, least_peak, progress.part(1, 2))
            solution = known.completed_by(rest)
        else:
            where = np.zeros(window.shape, bool)
            solution = pupil_form.solve(view, window, quadrature, narrow.in_focus, None, least_peak, progress)
        findings = (Finding("smooth blocks", False, why), *solution.findings)
        if not narrow.on_pixels.any():
            return replace(solution, findings=findings)
        missed = _missed(narrow, where, cut, window, lens, solution)
        if specular and specular.bending:
            # The positions at which a mirror or glass shows a narrow spot are not known.
            there = window.seen_in(specular.bending, lens)
            missed = np.maximum(missed, window.expand(there * UNCERTAINTY * narrow.on_pixels.max() * lens.etendue))
        return replace(solution, error=np.maximum(solution.error, missed), findings=findings)

    def _blocks(self, view: View, window: Window, quadrature: Quadrature) -> tuple[tuple[Blocks, ...], str]:
        """Blocks of pixels between which the image may be interpolated; the reason if there are none."""
        if not quadrature.takes("smooth blocks"):
            return (), "as requested"
        if quadrature.domain != "pupil" or view.specular:
            return (), "only lines of sight from the pixel straight to the first surface are interpolated"
        if math.isfinite(view.lens.optics.seen_field):
            return (), "an image-plane stop cuts blocks"
        state = (window, _view(view.lens))
        blocks = self._grid_of_blocks.recall(state, lambda: blocks_of(window, view.lens))
        return blocks, f"{' x '.join(map(str, window.shape[::-1]))} pixels are too few"

    def _by_blocks(
        self, view: View, blocks: tuple[Blocks, ...], quadrature: Quadrature, least_peak: float, progress: Progress
    ) -> Solution | None:
        """Solution with values interpolated between blocks; None if that saves no lines of sight."""
        # Light that is narrow for a pixel is narrow for a block, too.
        largest = blocks[0]
        narrow = self._narrow_light(replace(view, lens=largest.lens), largest.window)
        if (narrow.on_pixels > NARROW * quadrature.rtol * max(narrow.brightest, least_peak)).any():
            return None
        return interpolated.solve(view, blocks, quadrature, least_peak, progress)

    def _traced(self, scene: mi.Scene, lens: mi.Sensor) -> mi.Scene:
        """`scene`, or a robust copy if it loses rays. Tested once, and again if the geometry of a copy changes."""
        marks = [mark_of(emitter) for emitter in scene.emitters()]
        if marks == self._lossless:
            return scene
        shapes, old = scene.shapes(), self._robust
        state = (marks, [(shape_number(shape), _pose(shape)) for shape in shapes])
        if old is None or old.state != state:
            known = old is not None and old.state[0] == marks
            robust = robust_scene(scene, lens, warn=not known)
            if robust is scene:
                self._lossless, self._robust = marks, None
                return scene
            positions = tuple(buffers(shape)[0] for shape in shapes if shape.is_mesh())
            self._robust = old = RobustCopy(robust, state, positions)
        return old.scene

    def _visible_window(self, scene: mi.Scene, lens: mi.Sensor, everywhere: bool, bending: Boxes) -> Window:
        """Window of the pixels that can see an emitter or a `bending` shape, or of all `everywhere`; cached."""
        boxes = glowing_boxes(scene)
        state = (boxes, bending, _view(lens), everywhere)
        return self._window.recall(state, lambda: window_of(boxes, lens, everywhere, bending))

    def _faces_of(self, scene: mi.Scene) -> FaceTable | None:
        """Table of the scene's faces, None if `FaceTable.of` gives none; cached."""
        shapes = scene.shapes()
        edition = edition_of(shapes)
        return None if edition is None else self._faces.recall(edition, lambda: FaceTable.of(shapes))

    def _narrow_light(self, view: View, window: Window) -> NarrowLight:
        """Light of objects and spots that lines of sight may miss; cached."""
        scene, lens, specular = view.scene, view.lens, view.specular
        emitters = scene.emitters()
        editions = [(mark_of(emitter), getattr(emitter, "edition", 0)) for emitter in emitters]
        through = specular.state() if specular else ()
        state = (editions, glowing_boxes(scene), _poses(scene.shapes()), through, _view(lens), window)
        return self._narrow.recall(state, lambda: narrow_light(points_on_surfaces(scene, lens, specular), window))

    def render(
        self,
        scene: mi.Scene,
        sensor: mi.Sensor | int = 0,
        seed: int = 0,
        spp: int = 0,
        develop: bool = True,
        evaluate: bool = True,
    ) -> mi.TensorXf:
        """Power on every pixel [W], shape (h, w, 1)."""
        if not isinstance(sensor, mi.Sensor):
            sensor = scene.sensors()[sensor]
        with dr.resume_grad():
            asked = emitters_with_gradients(scene, sensor)
        if asked and kinds_of(scene, asked, self.quadrature) is None:
            self._refuse_specular(scene, sensor)
        solution = self.solve(scene, sensor)
        self._log_warnings(scene, sensor)
        return mi.TensorXf(solution.power[..., None].astype(np.float32))

    def render_forward(
        self,
        scene: mi.Scene,
        params: object,
        sensor: mi.Sensor | int = 0,
        seed: int = 0,
        spp: int = 0,
    ) -> mi.TensorXf:
        """Tangent of the image [W], shape (h, w, 1), from the tangents of the numbers behind `exitance`.

        Raises SceneError for gradients of any other parameter, and as `render`.
        """
        with self._derivative(scene, sensor) as (rows, view, emitters):
            tangent = rows.forward(view, self.quadrature, emitters)
        return mi.TensorXf(tangent[..., None].astype(np.float32))

    def render_backward(
        self,
        scene: mi.Scene,
        params: object,
        grad_in: mi.TensorXf,
        sensor: mi.Sensor | int = 0,
        seed: int = 0,
        spp: int = 0,
    ) -> None:
        """Apply the transpose of `render_forward` to `grad_in`, and add the result to the gradients behind `exitance`.

        grad_in : gradient with respect to the image, shape (h, w, 1) [1/W]
        Raises as `render_forward`.
        """
        with self._derivative(scene, sensor) as (rows, view, emitters):
            gradient = np.broadcast_to(np.array(grad_in, np.float64).reshape(-1, 1), (math.prod(rows.shape), 1))
            rows.backward(view, self.quadrature, emitters, gradient.reshape(rows.shape))

    @contextmanager
    def _derivative(self, scene: mi.Scene, sensor: mi.Sensor | int) -> Iterator[tuple[Rows, View, list[mi.Emitter]]]:
        """Context manager: rows of the derivative with respect to J_n, their view, and the emitters with gradients."""
        if not isinstance(sensor, mi.Sensor):
            sensor = scene.sensors()[sensor]
        with dr.resume_grad():
            emitters = emitters_with_gradients(scene, sensor)
        with dr.suspend_grad():
            kinds = kinds_of(scene, emitters, self.quadrature)
            if kinds is None:
                self._refuse_specular(scene, sensor)
            rows = self._rows_of(scene, sensor, kinds, sizes_of(emitters))
            check_scene(scene, sensor)
            with recording():
                yield rows, self._row_view(scene, sensor), emitters

    def _row_view(self, scene: mi.Scene, sensor: mi.Sensor) -> View:
        """The view through Mitsuba's surface records."""
        window = self._visible_window(scene, sensor, False, ())
        return View.of(self._traced(scene, sensor), sensor, window)

    def _rows_of(
        self, scene: mi.Scene, sensor: mi.Sensor, kinds: tuple[str, ...] | None, sizes: tuple[int, int]
    ) -> Rows:
        """Rows of the derivative with respect to J_n; cached, since they do not depend on J_n."""
        shapes = scene.shapes()
        positions = tuple(buffers(shape)[0] for shape in shapes if shape.is_mesh())
        marks = [mark_of(emitter) for emitter in scene.emitters()]
        linear = all(is_surface(emitter) and emitter.law.linear for emitter in scene.emitters())
        # Laws that depend on more than J_n may have changed.
        poses = [_pose(shape) for shape in shapes]
        state = (kinds or sizes, marks, poses, _view(sensor), object() if not linear else None)

        def find() -> Rows:
            with ExitStack() as stack:
                for emitter in scene.emitters():
                    if is_surface(emitter):
                        stack.enter_context(emitter.shining(1.0))
                picture = self.solve(scene, sensor)
                window = self._visible_window(scene, sensor, False, ())
                seen = window.expand(np.ones(window.shape)) > 0
                with recording(), dr.suspend_grad():
                    if kinds is None:
                        found = Rows.by_lines(self._row_view(scene, sensor), self.quadrature, picture, seen, sizes)
                    else:
                        found = Rows.on_meshes(scene, sensor, self.quadrature, picture, kinds)
                return replace(found, kept=positions)

        return self._rows.recall(state, find)

    def _refuse_specular(self, scene: mi.Scene, sensor: mi.Sensor) -> None:
        """Raise SceneError where light reaches the lens through or off specular shapes."""
        with dr.suspend_grad():
            specular = Specular.of(scene, sensor, self.quadrature)
        if specular:
            raise SceneError(
                f"fspt_integral: light reaches the lens through or off the specular shapes {', '.join(specular.names)}"
                ", which gradients do not follow. Leave them out, or render without gradients."
            )

    def _log_warnings(self, scene: mi.Scene, sensor: mi.Sensor) -> None:
        """Log what an image does not show and what is odd about the scene: each line once, when shapes or lens change.

        `mitsuba_fspt.render` has the same lines in its metadata.
        """
        shapes = scene.shapes()
        state = ([shape_number(shape) for shape in shapes], [_pose(shape) for shape in shapes], _view(sensor))

        def find() -> list[str]:
            left_out = self.light_left_out(scene, sensor)
            found = [left_out.warning(self.quadrature.rtol)] if left_out else []
            return [text for text in (*found, *scene_warnings(scene, sensor, self)) if text]

        for text in self._warnings.recall(state, find):
            if text not in self._logged:
                mi.Log(mi.LogLevel.Warn, f"fspt_integral: {text}.")
                self._logged.add(text)

    def to_string(self) -> str:
        return f"FsptIntegral[{self.quadrature}]"


def _refuse_meaningless(props: mi.Properties) -> None:
    """Raise SceneError for a parameter that Mitsuba's base classes accept and that would have no effect here."""
    for name in MEANINGLESS:
        if name in props:
            raise SceneError(
                f"fspt_integral: '{name}' has no meaning, light goes straight to the lens and nothing is sampled. "
                "Leave it out; 'rtol' and 'max_nodes' set accuracy and time."
            )


def _refuse_bending(specular: Specular | None, quadrature: Quadrature) -> None:
    """Raise SceneError for the surface form where light reaches the lens by reflection or refraction."""
    if quadrature.domain == "surface" and specular and specular.bending:
        raise SceneError(
            f"fspt_integral: 'domain' = surface follows light straight to the lens, but {', '.join(specular.names)} "
            "reflects or refracts it. Set it to pupil."
        )


def _quadrature_of(props: mi.Properties) -> Quadrature:
    """Quadrature from the integrator's parameters; SceneError if one is wrong."""
    defaults = Quadrature()
    shortcuts = props.get("shortcuts", True)
    if not isinstance(shortcuts, bool):
        raise SceneError(f"fspt_integral: 'shortcuts' must be true or false, got {shortcuts!r}. Give it as a boolean.")
    with named("fspt_integral"):
        return Quadrature(
            rtol=props.get("rtol", defaults.rtol),
            domain=str(props.get("domain", defaults.domain)),
            pixel=str(props.get("pixel", defaults.pixel)),
            max_nodes=props.get("max_nodes", defaults.max_nodes),
            max_specular=props.get("max_specular", defaults.max_specular),
            shortcuts_off=frozenset() if shortcuts else frozenset(SHORTCUTS),
        )


@dataclass(frozen=True)
class RobustCopy:
    """Robust copy of a scene that loses rays: of its shapes alone, so that nothing in it refers to the integrator.

    state : marks of the emitters, and numbers and poses of the shapes that it was built from
    positions : vertex buffers of the shapes. Poses are compared by the indices of these buffers; while the buffers are
        kept, no other one can get the same index
    """

    scene: mi.Scene
    state: tuple[list[object], list[tuple[int, tuple[float, ...]]]]
    positions: tuple[mi.Float, ...]


def _view(lens: mi.Sensor) -> tuple[object, ...]:
    """All parameters of a lens and its film that an image depends on."""
    film = lens.film()
    sizes = (int(n) for n in (*film.size(), *film.crop_size(), *film.crop_offset()))
    return (lens.optics, lens.pixel_pitch, lens.placement, *sizes)


def _poses(shapes: list[mi.Shape]) -> list[tuple[float, ...]]:
    """Poses of shapes, which may hide one another; empty for a single shape."""
    return [_pose(shape) for shape in shapes] if len(shapes) > 1 else []


def _pose(shape: mi.Shape) -> tuple[float, ...]:
    """Bounding box of a shape, with the index of its vertex buffer or the matrix of its `to_world`."""
    own = box_of([shape])
    box = (*own.min, *own.max)
    if shape.is_mesh():
        return (buffers(shape)[0].index, *box)
    parameters = mi.traverse(shape)
    return (*box, *np.ravel(parameters["to_world"].matrix).tolist()) if "to_world" in parameters else box


def _with_dark_coverage(solution: Solution, view: View, window: Window) -> Solution:
    """The surface form's `solution`, with the coverage of elements with J_n = 0 added, which that form leaves out."""
    if not any(finding.name == "dark" and finding.taken for finding in solution.findings):
        return solution
    met = np.where(solution.where, pupil_form.coverage_of(view, window), 0)
    return replace(solution, coverage=np.maximum(solution.coverage, met))


def _missed(
    narrow: NarrowLight, where: NDArray[np.bool_], cut: NDArray[np.bool_], window: Window, lens: mi.Sensor, of: Solution
) -> NDArray[np.float64]:
    """Light of narrow spots that lines of sight may miss [W], shape (h, w), on pixels without the surface form.

    where : pixels of the window that took the surface form
    cut : pixels that the border of the image-plane stop crosses, which always take lines of sight
    """
    light = np.where(where, 0, UNCERTAINTY * narrow.on_pixels)
    bright = window.expand(np.where(cut, light, 0)) * lens.etendue - of.power
    return np.maximum(bright, window.expand(np.where(cut, 0, light)) * lens.etendue)


def _outside(window: Window) -> Finding:
    """Finding about the pixels outside the visible window."""
    inside, pixels = window.count, math.prod(window.full)
    return Finding("outside", inside < pixels, f"{inside} of {pixels} pixels can see what glows")


mi.register_integrator("fspt_integral", FsptIntegral)
