"""Solution of Eq. 9 for a scene and a camera, by the forms that are right and quickest on each pixel."""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Callable
from dataclasses import replace
from functools import partial

import drjit as dr
import mitsuba as mi
import numpy as np

from ..camera.camera import Camera
from ..camera.window import Boxes, Window, window_of
from ..emission.face_table import FaceTable, editions_of
from ..emission.of_emitter import edition_of
from ..jit.mesh_buffers import face_count
from ..jit.recording import recording
from ..runtime.cached_value import CachedValue
from ..runtime.deadline import Deadline
from ..runtime.errors import SceneError
from .lines.eq9 import View
from .lines.nested_bsdfs import check_followed
from .lines.scene_checks import check_scene, check_surfaces_alone
from .lines.specular import Specular
from .lines.traced_scene import TracedScene, geometry_of, pose_of
from .lines.visible_window import glowing_boxes
from .progress import Progress
from .pupil import interpolated, pupil_form
from .pupil.dark_bodies import DarkBodies
from .pupil.interpolated import Blocks, blocks_of
from .pupil.narrow import NARROW, peak_of_points
from .pupil.seen_points import SeenPoints, Unseen
from .quadrature import FLOAT32_FLOOR, Quadrature
from .shortcuts import Finding
from .solution import Solution
from .surface import face_image, surface_form
from .surface.face_image import FaceImage
from .surface.face_light import FaceLight
from .tiles import Mosaic
from .work_log import WorkLog

LEAST_DISPLACEMENT = 1e-3  # pixels: least displacement of lines of sight by float32 that is added to the error
PLAIN = 0.7  # of rtol: tolerance of the light by plain courses (`Specular.part`); the rest is that of all others
OTHERS = 4  # largest number of lines of sight of a pixel over that for all other courses
MOST_KEPT = 1 << 20  # faces as a camera sees them, of 130 bytes each, that are kept between renders


class Solver:
    """Power on the pixels of a camera; it keeps what does not change from one solution of a scene to the next."""

    def __init__(self) -> None:
        # A reference to the scene itself would be a cycle: the integrator that holds this solver is its child.
        self._traced = TracedScene()
        self._window = CachedValue()
        self._unseen: dict[int, CachedValue] = defaultdict(CachedValue)  # by the side of blocks, 0 of the whole image
        self._faces, self._seen_faces, self._grid_of_blocks = (CachedValue() for _ in range(3))

    def solve(
        self,
        scene: mi.Scene,
        camera: Camera,
        quadrature: Quadrature,
        progress: Callable[[float], None] | None = None,
        *,
        narrow: bool = True,
        deadline: Deadline | None = None,
        log: WorkLog | None = None,
    ) -> Solution:
        """Power, error and coverage of the camera's crop window.

        A large film is solved in tiles; `progress` is called with the share done, 0 … 1, after every level of each
        tile. With `narrow` = False, objects and spots that lines of sight may miss are neither searched for nor
        contained in the error; that is meant for drafts of an image that is computed in full afterwards. After the
        `deadline` no pixel is refined further: its error is that of the level it has reached. Every pixel takes four
        lines of sight in any case. `log` takes the work of each step.

        Raises
        ------
        SceneError, ExitanceError : as in `check_scene`, or the scene has an environment emitter, or the memory does not
            suffice for the film.
        """
        state = Progress(progress, deadline=deadline or Deadline(), log=log)
        whole = self._whole(scene, camera, quadrature, state, narrow)
        if camera.shares is None:
            return whole
        found = whole.darkened(camera.shares)
        if found.beyond(quadrature.rtol)[0] > whole.beyond(quadrature.rtol)[0] and not state.deadline.passed():
            # The vignetting takes more of the brightest pixel than of others, whose errors count in terms of that.
            left = max(float(found.power.max() / whole.power.max()), FLOAT32_FLOOR / quadrature.rtol)
            finer = replace(quadrature, rtol=left * quadrature.rtol)
            found = self._whole(scene, camera, finer, state, narrow).darkened(camera.shares)
        return found

    def _whole(
        self,
        scene: mi.Scene,
        camera: Camera,
        quadrature: Quadrature,
        progress: Progress,
        narrow: bool,
    ) -> Solution:
        """The image without vignetting."""
        check_scene(scene, camera)
        check_surfaces_alone(scene)
        check_followed(scene)
        with recording(), dr.suspend_grad():
            specular = Specular.of(scene, camera, quadrature, even_if_none=not quadrature.takes("specular"))
            bending = specular.bending if specular else ()
            _refuse_bending(specular, quadrature)
            window = self.visible_window(scene, camera, not quadrature.takes("outside"), bending)
            mosaic = Mosaic(window)
            if mosaic.tiles:
                traced = self.traced(scene, camera)
                faces = self._faces_of(traced) if quadrature.takes("record") else None
                view = View.of(traced, camera, window, faces, specular)
                self._fill(mosaic, view, quadrature, progress, narrow)
            # Smaller displacements are random.
            rounding = camera.rounding if camera.rounding >= LEAST_DISPLACEMENT else 0.0
            solution = mosaic.solution(quadrature.least_error, rounding)
        return replace(solution, findings=(_outside(window), *solution.findings))

    def traced(self, scene: mi.Scene, camera: Camera) -> mi.Scene:
        """`scene`, or a robust copy if it loses rays."""
        return self._traced.of(scene, camera)

    def visible_window(self, scene: mi.Scene, camera: Camera, everywhere: bool, bending: Boxes) -> Window:
        """Window of the pixels that can see an emitter or a `bending` shape, or of all `everywhere`; cached."""
        boxes = glowing_boxes(scene)
        state = (boxes, bending, camera.state, everywhere)
        return self._window.recall(state, lambda: window_of(boxes, camera, everywhere, bending))

    def _faces_of(self, scene: mi.Scene) -> FaceTable | None:
        """Table of the scene's faces, None if `FaceTable.of` gives none; cached."""
        shapes = scene.shapes()
        edition = editions_of(shapes)
        return None if edition is None else self._faces.recall(edition, lambda: FaceTable.of(shapes))

    def _faces_seen(self, window: Window, view: View, convex: bool) -> list[FaceLight]:
        """`face_image.faces_seen` on the pixels of a window; cached unless there are more than `MOST_KEPT`."""
        scene, camera = view.scene, view.camera
        shapes = scene.shapes()
        state = (editions_of(shapes), [pose_of(shape) for shape in shapes], camera.state, window, convex)
        find = partial(face_image.faces_seen, scene, camera, window, convex)
        if sum(face_count(shape) for shape in shapes if shape.is_mesh()) > MOST_KEPT:
            return find()
        return self._seen_faces.recall(state, find, [geometry_of(shape) for shape in shapes])

    def _unseen_on(self, view: View, window: Window, side: int = 0) -> Unseen:
        """Light and shade that lines of sight may miss on the pixels of a window, or on blocks of a `side`; cached."""
        held = [geometry_of(shape) for shape in view.scene.shapes()]
        state = _seen_state(view, window)
        return self._unseen[side].recall(state, lambda: SeenPoints.of(view).unseen(window), held)

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
        least_peak, points = 0.0, None if narrow else SeenPoints(view, None)
        progress(0.0)
        if len(tiles) > 1 and narrow:
            points = SeenPoints.of(view)
            least_peak = max(pupil_form.peak_of_few(view, window, quadrature), peak_of_points(points.straight, window))
        for k, tile in enumerate(tiles):
            unseen = partial(points.unseen, tile) if points else partial(self._unseen_on, view, tile)
            mosaic.put(tile, self._solve_tile(tile, view, quadrature, unseen, least_peak, progress.part(k, len(tiles))))

    def _solve_tile(
        self,
        window: Window,
        view: View,
        quadrature: Quadrature,
        find_unseen: Callable[[], Unseen],
        least_peak: float,
        progress: Progress,
    ) -> Solution:
        """Solution by the requested form of Eq. 9; pixels with light of narrow spots always take the surface form.

        least_peak : lower bound of the brightest pixel of all tiles [W/mm²/sr]
        """
        scene, camera, specular = view.scene, view.camera, view.specular
        # The surface form ignores the border of the image-plane stop: pixels that the border crosses take lines of
        # sight.
        inside, cut = window.field_stop(camera)
        everywhere = quadrature.domain == "surface"
        if everywhere and not cut.any():
            return self._by_surface(window, view, quadrature, least_peak, progress)
        blocks, why = self._blocks(view, window, quadrature)
        if blocks:
            if solution := self._by_blocks(view, blocks, quadrature, least_peak, progress):
                return solution
            why = "most blocks of pixels have an edge, or light too narrow for them"
        unseen = find_unseen()
        narrow, dark = unseen.straight, unseen.dark
        where, peak = inside, least_peak
        if not everywhere:
            where = inside & (narrow.on_pixels > NARROW * quadrature.rtol * max(narrow.brightest, least_peak))
            where &= dark.shade <= NARROW * quadrature.rtol  # shade takes lines of sight
            peak = max(narrow.brightest / 2, least_peak)
        if specular and specular.bending:  # the surface form contains only light that goes straight to the lens
            where = np.zeros(window.shape, bool)
        if progress.deadline.passed():
            where = np.zeros(window.shape, bool)
        by_faces = self._face_image(window, view, quadrature, peak)
        on_faces = where & window.fully_open(camera) if by_faces else np.zeros(window.shape, bool)
        by_elements = where & ~on_faces
        form = partial(pupil_form.solve, view, window, quadrature, dark=dark)
        if by_elements.any():
            part, rest = progress.part(0, 2), progress.part(1, 2)
            known = surface_form.solve(scene, camera, window, quadrature, by_elements, peak, part, specular)
            known = _with_dark_coverage(known, view, window)
            solution = known.completed_by(form(narrow, known, least_peak, rest, by_faces, on_faces))
        elif by_faces:
            solution = form(narrow, None, least_peak, progress, by_faces, on_faces)
        elif specular and specular.bending and specular.branching:
            solution = _by_courses(view, window, quadrature, unseen, least_peak, progress)
        else:
            solution = form(narrow.plus(unseen.elsewhere), None, least_peak, progress)
        error = np.maximum(solution.error, window.expand(unseen.anywhere) * camera.etendue)
        findings = (Finding("smooth blocks", False, why), *solution.findings)
        solution = replace(solution, error=error, findings=findings)
        return _with_dark_bodies(solution, view, window, dark) if everywhere else solution

    def _by_surface(
        self, window: Window, view: View, quadrature: Quadrature, least_peak: float, progress: Progress
    ) -> Solution:
        """Solution by the surface form alone: from the faces of meshes, from elements of other surfaces."""
        scene, camera = view.scene, view.camera
        dark_too = not quadrature.takes("dark")
        by_faces = self._face_image(window, view, quadrature, least_peak, dark_too)
        if by_faces and window.fully_open(camera).all():
            known = by_faces.run(np.ones(window.shape, bool), least_peak, progress, surface_form.MOST_LINES)
            if progress.log:
                progress.log.add("images of faces", window.count, known.rays)
            shaded = by_faces.shaded  # faces that shadows cross have them
        else:
            known = surface_form.solve(scene, camera, window, quadrature, None, least_peak, progress, view.specular)
            shaded = np.zeros(window.shape, bool)
        found, dark = _with_dark_coverage(known, view, window), DarkBodies.seen(view, window)
        return _with_dark_bodies(found, view, window, replace(dark, shade=np.where(shaded, 0, dark.shade)))

    def _face_image(
        self, window: Window, view: View, quadrature: Quadrature, least_peak: float, dark_too: bool = True
    ) -> FaceImage | None:
        """Image by the faces of all emitters, None where it does not apply."""
        if view.specular or not face_image.applies(view.scene, quadrature):
            return None
        seen = partial(self._faces_seen, window, view, quadrature.takes("occlusion"))
        return FaceImage(view.scene, view.camera, window, quadrature, least_peak, seen, dark_too)

    def _blocks(self, view: View, window: Window, quadrature: Quadrature) -> tuple[tuple[Blocks, ...], str]:
        """Blocks of pixels between which the image may be interpolated; the reason if there are none."""
        if not quadrature.takes("smooth blocks"):
            return (), "as requested"
        if quadrature.domain != "pupil" or view.specular:
            return (), "only lines of sight from the pixel straight to the first surface are interpolated"
        if math.isfinite(view.camera.lens.seen_field):
            return (), "an image-plane stop cuts blocks"
        state = (window, view.camera.state)
        blocks = self._grid_of_blocks.recall(state, lambda: blocks_of(window, view.camera))
        return blocks, f"{' x '.join(map(str, window.shape[::-1]))} pixels are too few"

    def _by_blocks(
        self, view: View, blocks: tuple[Blocks, ...], quadrature: Quadrature, least_peak: float, progress: Progress
    ) -> Solution | None:
        """Solution with values interpolated between blocks; None if that saves no lines of sight."""

        # Light that is narrow for a pixel is narrow for a block, too.
        def find_unseen(some: Blocks) -> Unseen:
            """Light and shade on blocks."""
            return self._unseen_on(replace(view, camera=some.camera), some.window, some.side)

        narrow = find_unseen(blocks[0]).straight
        if (narrow.on_pixels > NARROW * quadrature.rtol * max(narrow.brightest, least_peak)).any():
            return None
        return interpolated.solve(view, blocks, quadrature, find_unseen, least_peak, progress)


def _seen_state(view: View, window: Window) -> tuple[object, ...]:
    """What the light of surfaces on the pixels of a window depends on."""
    scene, specular = view.scene, view.specular
    editions = [edition_of(emitter) for emitter in scene.emitters()]
    through = specular.state() if specular else ()
    poses = [pose_of(shape) for shape in scene.shapes()]
    most = (specular.most, specular.least) if specular else ()
    return editions, glowing_boxes(scene), poses, through, most, view.camera.state, window


def _refuse_bending(specular: Specular | None, quadrature: Quadrature) -> None:
    """Raise SceneError for the surface form where light reaches the lens by reflection or refraction."""
    if quadrature.domain == "surface" and specular and specular.bending:
        raise SceneError(
            f"fspt_integral: 'domain' = surface follows light straight to the camera, but {', '.join(specular.names)} "
            "reflects or refracts it. Set it to pupil."
        )


def _by_courses(
    view: View,
    window: Window,
    quadrature: Quadrature,
    unseen: Unseen,
    least_peak: float,
    progress: Progress,
) -> Solution:
    """Solution by the pupil form, for the light by plain courses of lines of sight and by all others one by one.

    Of every window the reflected light is much fainter than the transmitted one, so that few lines of sight suffice for
    it. A line of sight takes one leg a surface along a plain course; the number of all courses grows as a product.
    """
    if view.specular is None:
        raise TypeError("no specular surfaces")
    plain, others = (replace(view.specular, part=part) for part in ("plain", "others"))
    views = [replace(view, specular=own) for own in (plain, replace(others, least=others.faintest))]
    shares = [replace(quadrature, rtol=max(share * quadrature.rtol, FLOAT32_FLOOR)) for share in (PLAIN, 1 - PLAIN)]
    few = max(quadrature.most_nodes // OTHERS, 1)
    if quadrature.max_nodes is not None:
        shares[0] = replace(shares[0], max_nodes=max(quadrature.max_nodes - few, 1))
    shares[1] = replace(shares[1], max_nodes=few)
    first, rest = progress.part(0, 2), progress.part(1, 2)
    narrow = unseen.straight.plus(unseen.elsewhere)
    image = pupil_form.solve(views[0], window, shares[0], narrow, None, least_peak, first, dark=unseen.dark)
    peak = max(float((image.power - image.error).max(initial=0.0)) / view.camera.etendue, least_peak)
    others = replace(unseen.elsewhere, in_focus=unseen.straight.in_focus)
    return image.plus(pupil_form.solve(views[1], window, shares[1], others, None, peak, rest))


def _with_dark_coverage(solution: Solution, view: View, window: Window) -> Solution:
    """The surface form's `solution`, with the coverage of elements with J_n = 0 added, which that form leaves out."""
    if not any(finding.name == "dark" and finding.taken for finding in solution.findings):
        return solution
    met = np.where(solution.where, pupil_form.coverage_of(view, window), 0)
    return replace(solution, coverage=np.maximum(solution.coverage, met))


def _with_dark_bodies(solution: Solution, view: View, window: Window, dark: DarkBodies) -> Solution:
    """The surface form's `solution`; what narrow dark bodies hide, and what passes between them, is an error, as that
    form may miss both."""
    etendue = view.camera.etendue
    light = window.cut(solution.power) / etendue
    missed = np.maximum(dark.taken(light), dark.let_through(light)) * etendue
    return replace(solution, error=np.maximum(solution.error, window.expand(missed)))


def _outside(window: Window) -> Finding:
    """Finding about the pixels outside the visible window."""
    inside, pixels = window.count, math.prod(window.full)
    return Finding("outside", inside < pixels, f"{inside} of {pixels} pixels can see what glows")
