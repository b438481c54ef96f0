"""How the camera of a query stands to that of a place: the turn and the shift between two pictures of one scene.

Directions are unit vectors p of the place's camera and q of the query's.  If the query's camera has the centre c and
the rotation R, two models say how they belong together:

* a plane: q ~ R (p - c (n · p)), where n · p is the nearness (1 / distance) of the plane in the direction of p.  A
  camera that has only turned is the case c = 0.  A match misses it in two directions.
* any rigid scene: c · (p x R^T q) = 0, the epipolar constraint.  A match misses it in one direction, as the distance of
  each point is free.  Where the scene is a plane, or c = 0, it leaves R and c open.

Each is fitted by the method of Gauss and Newton with robust weights: the plane from the rotation alone (Kabsch, 1976)
and from the decompositions of a homography, the rigid scene from the rotation alone and from an essential matrix, both
matrices by MAGSAC++ (Barath et al., CVPR 2020).  Which model holds is decided by the geometric robust information
criterion (Torr, "Geometric motion segmentation and model selection", 1998).  Answers that are nearly as good, such as
the two that one plane allows, make a mixture, whose mean and covariance are given.

The covariance of an answer is the inverse of its normal equations, by the noise of its residuals.  How far the scene is
is not known, so shifts are in units of its typical distance.  Without intrinsics a field of view of 68 degrees is
assumed.  A turn is in proportion to the focal length that is assumed, to first order, so the deviation of its logarithm
times the turn is a part of the covariance.
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from core.frames.intrinsics import Intrinsics
from core.geometry.detection import shown_scale
from core.geometry.keypoints import RESOLUTION, Keypoints
from core.geometry.verification import CERTAINTY, THRESHOLD, Verification
from core.kernels import views as kernels

Array = NDArray[np.float64]
Source = Literal["intrinsics", "field-of-view"]

ATTEMPTS = 100
"""Of MAGSAC++, to find a matrix that begins the search."""
LEAST_INLIERS = 12
"""Eight values are estimated; fewer matches than this hardly say how well."""
LEAST_EVIDENCE = 25.0
"""Of a verification; with less, the matches of half of the pictures turned by known angles led to wrong answers."""
MOST_MATCHES = 200
"""More matches are thinned out evenly: their errors are not independent, and each costs time."""
NOISE = 0.7
"""Pixels by which a keypoint is off, of the picture as the network of keypoints sees it; measured afterwards."""
NOISE_LIMITS = 0.4, 4.0
"""Factors of NOISE within which the measured noise is believed."""
OUTLYING = 4.0
"""Residuals of this many deviations weigh a quarter (Geman and McClure, 1985)."""
SHIFT_DEVIATION = 1.0
"""Prior deviation of each coordinate of the shift, in typical distances: views of one place are not farther apart."""
SLOPE_DEVIATION = 1.0
"""Prior deviation of the tilt of a plane, the tangent of the angle by which it does not face the camera."""
SCALE_DEVIATION = 0.3
"""Deviation of the logarithm of the length of a shift: which points are typical is a matter of chance."""
PER_MATCH, PER_VALUE = float(np.log(4)), 4.0
"""The penalties of the criterion for the free distance of each match, and for each value within a logarithm (Torr's
λ1 and λ2)."""
TEMPERATURE = 4.0
"""Answers are weighed by the exponential of half their criterion over this, as matches are no independent evidence."""
HOPELESS = 150.0
"""Answers with a criterion that is worse by more at first are not considered again."""
NEGLIGIBLE = 1e-3
"""Weight from which on an answer is a part of the mixture."""
INFLATION = 1.5
"""Factor of the covariance, as errors of keypoints are not independent; chosen on photographs that were turned."""
FOCAL, FOCAL_DEVIATION = 0.741, 0.35
"""Focal length over the longer side where it is not known, a field of view of 68 degrees, and the deviation of its
logarithm: two deviations are fields of 37 and 107 degrees."""
LEAST_COSINE = 0.5
"""Cosine between most directions of the two cameras, turned: an essential matrix fits some answers with points behind a
camera as well, in which they are opposed."""
MOST_SHIFT = 3.0
"""Typical distances that a shift is at most."""
LEAST_NEARNESS = 0.02
"""A plane is at most 50 times as far as straight ahead."""
LEAST_AHEAD = 0.1
"""Cosine of the angle to the optical axis from which on a direction is ahead."""
SAME = 1e-3
"""Rotations and shifts that differ by less are one."""
FIRST_STEPS, MOST_STEPS = 5, 15
"""Towards a minimum: from each start, and from those that are worth it."""
ENOUGH = 0.05
"""The cost is twice a logarithm of a likelihood; a step that lowers it by less is the last."""

BODY = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
"""From a camera's optical frame (right, down, ahead) to the axes of ROS (ahead, left, up)."""


@dataclass(frozen=True)
class RelativeView:
    """The camera of a query in the frame of a place's camera, of which x points ahead, y to the left and z up.

    turn: float64 [3, 3], the rotation from the axes of the query's camera to those of the place's.
    shift: float64 [3], the centre of the query's camera, in units of the typical distance of the points that both see.
    covariance: float64 [6, 6], of a small rotation about the place's axes that follows the turn (radians), and of the
        shift.
    inliers: how many matches fit.
    source: the cameras' intrinsics, or a range of fields of view where one of them has none.
    share: of keypoints, that the verification of the place found to fit (``Verification.inlier_share``).
    """

    turn: Array
    shift: Array
    covariance: Array
    inliers: int
    source: Source
    share: float = 1.0

    @property
    def heading_offset(self) -> float:
        """How far the query's camera looks to the left of where the place's looks, in degrees in (-180, 180]."""
        return float(np.degrees(np.arctan2(self.turn[1, 0], self.turn[0, 0])))

    @property
    def heading_spread(self) -> float:
        """Standard deviation of the offset of the heading, in degrees."""
        return float(np.degrees(np.sqrt(self.covariance[2, 2])))


@dataclass(frozen=True)
class SharedPoints:
    """The points that a query and a place see.

    numbers: int64 [n], of the query's keypoints; ascending.
    query, place: unit vectors in the optical frames (right, down, ahead), float64 [n, 3]; NaN where not known.
    fitting: bool [n], the inliers of the verification.
    likeness: float64 [n], the cosine of both descriptors.
    pixel: the angle in radians that a pixel covers, of a frame as the network of keypoints sees it.
    """

    numbers: NDArray[np.int64]
    query: Array
    place: Array
    fitting: NDArray[np.bool_]
    likeness: Array
    pixel: float

    def usable(self) -> NDArray[np.bool_]:
        """Which points fit and are seen in known directions, bool [n]."""
        known = np.isfinite(self.place).all(axis=1) & np.isfinite(self.query).all(axis=1)
        return np.asarray(self.fitting & known)


def sighting_of(
    query: Keypoints,
    place: Keypoints,
    verification: Verification,
    query_camera: Intrinsics | None = None,
    place_camera: Intrinsics | None = None,
) -> SharedPoints | None:
    """The points that a query shares with a place that was verified; arguments and errors as :func:`relative_view`.

    Returns:
        None if the evidence is less than LEAST_EVIDENCE.
    """
    if verification.evidence < LEAST_EVIDENCE:
        return None
    ours, theirs = verification.matches.T
    seen, known = query.pixels()[ours], place.pixels()[theirs]
    at, shown = (
        _pinhole(frame) if camera is None else camera.of_size(frame.width, frame.height)
        for camera, frame in ((query_camera, query), (place_camera, place))
    )
    pixel = np.hypot(at.pixel * _enlargement(query), shown.pixel * _enlargement(place)) / np.sqrt(2)
    alike = np.einsum("nd,nd->n", query.descriptors[ours].astype(np.int64), place.descriptors[theirs]) / RESOLUTION**2
    return SharedPoints(ours, at.bearings(seen), shown.bearings(known), verification.inliers, alike, float(pixel))


def relative_view(
    query: Keypoints,
    place: Keypoints,
    verification: Verification,
    query_camera: Intrinsics | None = None,
    place_camera: Intrinsics | None = None,
) -> RelativeView | None:
    """The turn and the shift between a query and a place that was verified.

    Args:
        query_camera, place_camera: the intrinsics, of any size that fits the frames; None where they are not known.

    Returns:
        None if the evidence is less than LEAST_EVIDENCE, or fewer than LEAST_INLIERS matches fit.

    Raises:
        UnfitIntrinsics: intrinsics do not fit the frame.
    """
    sighting = sighting_of(query, place, verification, query_camera, place_camera)
    if sighting is None:
        return None
    view = view_of_bearings(sighting.place, sighting.query, sighting.pixel)
    if view is None:
        return None
    view = replace(view, share=verification.inlier_share)
    return _by_assumed_field(view) if None in (query_camera, place_camera) else view


def _by_assumed_field(view: RelativeView) -> RelativeView:
    """The view of a camera whose focal length was assumed, with the uncertainty of its turn that follows."""
    turn, covariance = _vector(view.turn), view.covariance.copy()
    covariance[:3, :3] += np.outer(turn, turn) * FOCAL_DEVIATION**2
    return replace(view, covariance=covariance, source="field-of-view")


def _pinhole(frame: Keypoints) -> Intrinsics:
    """The intrinsics of a camera without distortion, of the focal length that is assumed."""
    length = FOCAL * max(frame.width, frame.height)
    middle = (frame.width - 1) / 2, (frame.height - 1) / 2
    return Intrinsics(width=frame.width, height=frame.height, fx=length, fy=length, cx=middle[0], cy=middle[1])


def _enlargement(frame: Keypoints) -> float:
    """Pixels of the frame per pixel of a frame as the network of keypoints sees it."""
    return 1 / shown_scale(frame.width, frame.height)


def view_of_bearings(place: Array, query: Array, pixel: float) -> RelativeView | None:
    """The turn and the shift between two cameras that see the same points.

    Args:
        place, query: unit vectors in the optical frames (right, down, ahead), float64 [n, 3]; NaN where not known.
        pixel: the angle in radians that a pixel covers, of a frame as the network of keypoints sees it.

    Returns:
        None if fewer than LEAST_INLIERS fit.
    """
    known = np.flatnonzero(np.isfinite(place).all(axis=1) & np.isfinite(query).all(axis=1))
    if len(known) < LEAST_INLIERS:
        return None
    known = known[np.linspace(0, len(known) - 1, min(len(known), MOST_MATCHES)).round().astype(np.int64)]
    p, q = place[known], query[known]
    fits = _distinct([_minimized(p, q, start, NOISE * pixel, FIRST_STEPS) for start in _starts(p, q, pixel)])
    noise = min(_noise(p, q, fit, pixel) for fit in fits)
    plane = min((fit for fit in fits if isinstance(fit, _Plane)), key=lambda fit: _criterion(p, q, fit, noise))
    good = min(_criterion(p, q, fit, noise) for fit in fits) + HOPELESS
    fits = [fit for fit in [*fits, *plane.twins(p)] if _criterion(p, q, fit, noise) < good]
    fits = _distinct([_minimized(p, q, fit, noise) for fit in fits])
    criteria = [_criterion(p, q, fit, noise) for fit in fits]
    views = []
    for criterion, fit in sorted(zip(criteria, fits, strict=True), key=lambda pair: pair[0]):
        weight = float(np.exp((min(criteria) - criterion) / (2 * TEMPERATURE)))
        if weight > NEGLIGIBLE and np.median((q @ fit.rotation * p).sum(axis=1)) > LEAST_COSINE:
            view = _view(p, q, fit, _noise(p, q, fit, pixel))
            views += [(weight, view)] if view.inliers >= LEAST_INLIERS else []
    return _mixture(views) if views else None


@dataclass(frozen=True)
class _Plane:
    """R, c and how the plane is tilted to the right and down; distances are in units of that straight ahead."""

    rotation: Array
    centre: Array
    tilt: Array

    free_distances = 0
    values = 8
    prior = np.r_[np.zeros(3), np.full(3, 1 / SHIFT_DEVIATION**2), np.full(2, 1 / SLOPE_DEVIATION**2)]

    def at(self) -> Array:
        """The values that the prior is of, float64 [8]."""
        return np.concatenate([np.zeros(3), self.centre, self.tilt])

    def moved(self, step: Array) -> _Plane:
        """The plane after a step of its values."""
        return _Plane(_rotation(step[:3]) @ self.rotation, self.centre + step[3:6], self.tilt + step[6:])

    def is_like(self, other: _Plane | _RigidScene) -> bool:
        """Whether the other is a plane in which the cameras have the same poses."""
        apart = float(np.abs(self.rotation - other.rotation).max() + np.abs(self.centre - other.centre).max())
        return isinstance(other, _Plane) and apart < SAME

    def twins(self, p: Array) -> list[_Plane]:
        """The other answers that give the same picture: a plane has two of them, as the text above says."""
        homography = self.rotation @ (np.eye(3) - np.outer(self.centre, np.r_[-self.tilt, 1.0]))
        return _planes_of(homography, p)

    def squares(self, p: Array, q: Array) -> Array:
        """The squares of what points miss, float64 [n].

        That is the difference of two unit vectors, almost at right angles to both, so its length is an angle.  Both
        directions have the same noise, hence half of the square.
        """
        found = np.empty(len(p))
        kernels.plane_squares(p, q, self.rotation, self.centre, self.tilt, LEAST_NEARNESS, found)
        return found

    def add_equations(self, p: Array, q: Array, noise: float, normal: Array, gradient: Array) -> None:
        """Add the points to the normal equations, [8, 8] and [8]."""
        kernels.plane_equations(
            p, q, self.rotation, self.centre, self.tilt, LEAST_NEARNESS, 1 / noise**2, OUTLYING**2, normal, gradient
        )

    def shift(self, p: Array, q: Array, covariance: Array) -> tuple[Array, Array]:
        """c in units of the typical distance of the points, and the covariance of ω and it, [6, 6]."""
        nearness = float(np.median(np.maximum(p @ np.r_[-self.tilt, 1.0], LEAST_NEARNESS)))
        change = np.diag(np.r_[np.ones(3), np.full(3, nearness)])
        return self.centre * nearness, change @ covariance[:6, :6] @ change


@dataclass(frozen=True)
class _RigidScene:
    """R and the direction of c, a unit vector."""

    rotation: Array
    centre: Array

    free_distances = 1
    values = 5
    prior = np.zeros(5)

    def at(self) -> Array:
        """The values that the prior is of, float64 [5]."""
        return np.zeros(5)

    def moved(self, step: Array) -> _RigidScene:
        """The scene after a step of its values."""
        centre = self.centre + _across(self.centre) @ step[3:]
        return _RigidScene(_rotation(step[:3]) @ self.rotation, centre / np.linalg.norm(centre))

    def is_like(self, other: _Plane | _RigidScene) -> bool:
        """Whether the other is a rigid scene with the same poses of the cameras; the sign of c does not matter."""
        apart = float(np.abs(self.rotation - other.rotation).max() + 1 - abs(self.centre @ other.centre))
        return isinstance(other, _RigidScene) and apart < SAME

    def squares(self, p: Array, q: Array) -> Array:
        """The squares of what points miss, float64 [n]: Sampson's error, on the sphere an angle."""
        found = np.empty(len(p))
        kernels.rigid_squares(p, q, self.rotation, self.centre, found)
        return found

    def add_equations(self, p: Array, q: Array, noise: float, normal: Array, gradient: Array) -> None:
        """Add the points to the normal equations, [5, 5] and [5]."""
        across = _across(self.centre)
        kernels.rigid_equations(p, q, self.rotation, self.centre, across, 1 / noise**2, OUTLYING**2, normal, gradient)

    def shift(self, p: Array, q: Array, covariance: Array) -> tuple[Array, Array]:
        """c in units of the typical distance of the points, and the covariance of ω and it, [6, 6]."""
        distances = _distances(p, q @ self.rotation, self.centre)
        centre = self.centre
        if np.mean(distances > 0) < 0.5:  # the points are behind the cameras: the shift has the other sign
            distances, centre = -distances, -centre
        ahead = distances[distances > 0]
        length = min(1 / float(np.median(ahead)), MOST_SHIFT) if len(ahead) else 0.0
        change = np.zeros((6, 5))
        change[:3, :3], change[3:, 3:] = np.eye(3), length * _across(self.centre) * np.sign(centre @ self.centre)
        found = change @ covariance @ change.T
        found[3:, 3:] += np.outer(centre, centre) * (length * SCALE_DEVIATION) ** 2
        return centre * length, found


_Model = _Plane | _RigidScene


def _starts(p: Array, q: Array, pixel: float) -> list[_Model]:
    """Where the minima are looked for."""
    turned = _only_turned(p, q, NOISE * pixel)
    found: list[_Model] = [
        _Plane(turned, np.zeros(3), np.zeros(2)),
        _RigidScene(turned, _best_direction(p, q @ turned)),
    ]
    ahead = (p[:, 2] > LEAST_AHEAD) & (q[:, 2] > LEAST_AHEAD)
    if ahead.sum() < LEAST_INLIERS:
        return found
    images = p[ahead, :2] / p[ahead, 2:], q[ahead, :2] / q[ahead, 2:]
    with suppress(cv2.error):  # of some degenerate matches
        matrix, _ = cv2.findHomography(*images, cv2.USAC_MAGSAC, 2 * THRESHOLD * pixel, None, ATTEMPTS, CERTAINTY)
        if matrix is not None:
            found += _planes_of(np.asarray(matrix, np.float64), p)
    with suppress(cv2.error):
        essential, inliers = cv2.findEssentialMat(
            images[0], images[1], np.eye(3), cv2.USAC_MAGSAC, CERTAINTY, THRESHOLD * pixel, ATTEMPTS
        )
        if essential is not None and essential.shape == (3, 3):
            _, rotation, translation, _ = cv2.recoverPose(essential, *images, np.eye(3), mask=inliers)
            attitude = np.asarray(rotation, np.float64)
            found.append(_RigidScene(attitude, -attitude.T @ np.asarray(translation, np.float64)[:, 0]))
    return found


def _distinct(models: Sequence[_Model]) -> list[_Model]:
    """The models without those that are as good as another of their kind."""
    found: list[_Model] = []
    for model in models:
        if not any(model.is_like(other) for other in found):
            found.append(model)
    return found


def _only_turned(p: Array, q: Array, noise: float) -> Array:
    """The rotation that brings p to q best (Kabsch, 1976), with weights that let wrong matches count for little."""
    weights = np.ones(len(p))
    rotation = np.eye(3)
    for _ in range(8):
        u, _, v = np.linalg.svd((q * weights[:, np.newaxis]).T @ p)
        rotation = u @ np.diag([1, 1, np.linalg.det(u @ v)]) @ v
        squares = np.square(q - p @ rotation.T).sum(axis=1)
        weights = 1 / (1 + squares / (OUTLYING**2 * max(noise**2, float(np.median(squares)))))
    return rotation


def _planes_of(matrix: Array, p: Array) -> list[_Plane]:
    """The planes ahead, and the shifts, that a homography allows."""
    found = []
    _, rotations, translations, normals = cv2.decomposeHomographyMat(matrix, np.eye(3))
    for turned, translation, normal in zip(rotations, translations, normals, strict=True):
        rotation, towards = np.asarray(turned, np.float64), np.asarray(normal, np.float64)[:, 0]
        if np.linalg.det(rotation) > 0 and towards[2] > LEAST_AHEAD and np.mean(p @ towards > 0) > 0.5:
            centre = -rotation.T @ np.asarray(translation, np.float64)[:, 0] * towards[2]
            found.append(_Plane(rotation, centre, -towards[:2] / towards[2]))
    return found


def _best_direction(p: Array, turned: Array) -> Array:
    """The unit vector c for which the squares of c · (p x u) are least, float64 [3]."""
    planes = _cross(p, turned)
    return np.ascontiguousarray(np.linalg.eigh(planes.T @ planes)[1][:, 0])


def _distances(p: Array, turned: Array, centre: Array) -> Array:
    """How far along p the point is at which both rays are nearest to each other, float64 [n]."""
    across = _cross(p, turned)
    return (_cross(centre, turned) * across).sum(axis=1) / np.maximum(np.square(across).sum(axis=1), 1e-12)


def _across(direction: Array) -> Array:
    """Two unit vectors at right angles to one, float64 [3, 2] (Duff et al., Building an orthonormal basis, 2017)."""
    x, y, z = direction.tolist()
    sign = 1.0 if z >= 0 else -1.0
    a = -1 / (sign + z)
    b = x * y * a
    return np.array([[1 + sign * x * x * a, b], [sign * b, sign + y * y * a], [-sign * x, -y]])


def _cross(a: Array, b: Array) -> Array:
    """a × b, float64 [n, 3], of [n, 3] and [n, 3] or [3]; several times as fast as NumPy's for so few vectors."""
    (x, y, z), (u, v, w) = a.T, b.T
    return np.stack([y * w - z * v, z * u - x * w, x * v - y * u], axis=1)


def _minimized(p: Array, q: Array, model: _Model, noise: float, steps: int = MOST_STEPS) -> _Model:
    """The model at the minimum of the robust cost that is reached from it (Levenberg and Marquardt)."""
    cost, damping = _cost(p, q, model, noise), 1e-3
    normal, gradient = _normal_equations(p, q, model, noise)
    for _ in range(steps):
        damped = normal + damping * np.diag(np.diag(normal) + 1e-9)
        tried = model.moved(-np.asarray(np.linalg.solve(damped, gradient), np.float64))
        less = cost - _cost(p, q, tried, noise)
        if less > 0:
            model, cost, damping = tried, cost - less, damping / 5
            if less < ENOUGH:
                break
            normal, gradient = _normal_equations(p, q, model, noise)
        elif damping > 1e6:
            break
        else:
            damping *= 10
    return model


def _cost(p: Array, q: Array, model: _Model, noise: float) -> float:
    """Twice the negative log likelihood with the prior, but for constants."""
    squares = model.squares(p, q) / noise**2
    return float((squares / (1 + squares / OUTLYING**2)).sum() + model.prior @ np.square(model.at()))


def _normal_equations(p: Array, q: Array, model: _Model, noise: float) -> tuple[Array, Array]:
    normal, gradient = np.diag(model.prior), model.prior * model.at()
    model.add_equations(p, q, noise, normal, gradient)
    return normal, gradient


def _noise(p: Array, q: Array, model: _Model, pixel: float) -> float:
    """The noise of directions, by the median of the squared residuals."""
    median = 0.455 if model.free_distances else 1.386  # of χ² with one and with two degrees of freedom
    free = max(0.2, 1 - model.values / ((2 - model.free_distances) * len(p)))
    low, high = NOISE_LIMITS
    measured = np.sqrt(np.median(model.squares(p, q)) / median / free)
    return float(np.clip(measured, low * NOISE * pixel, high * NOISE * pixel))


def _criterion(p: Array, q: Array, model: _Model, noise: float) -> float:
    """The geometric robust information criterion (Torr, 1998, eq. 19); less is better."""
    missed = np.minimum(model.squares(p, q) / noise**2, 2 * (2 - model.free_distances)).sum()
    prior = model.prior @ np.square(model.at())
    return float(missed + PER_MATCH * (2 + model.free_distances) * len(p) + PER_VALUE * model.values + prior)


def _view(p: Array, q: Array, model: _Model, noise: float) -> RelativeView:
    normal, _ = _normal_equations(p, q, model, noise)
    inverse = np.asarray(np.linalg.inv(normal + np.diag(np.full(len(normal), 1e-9))), np.float64)
    centre, covariance = model.shift(p, q, INFLATION * inverse)
    inliers = int((model.squares(p, q) < (3 * noise) ** 2).sum())
    # A rotation that precedes R by -Rᵀ ω is one that follows it by ω; both in the axes of ROS.
    change = np.zeros((6, 6))
    change[:3, :3], change[3:, 3:] = -BODY @ model.rotation.T, BODY
    turn = BODY @ model.rotation.T @ BODY.T
    return RelativeView(turn, BODY @ centre, change @ covariance @ change.T, inliers, "intrinsics")


def mixture_moments(weights: Array, means: Array, covariances: Array) -> tuple[Array, Array]:
    """Mean and covariance of a mixture: how far its parts are apart adds to the covariance of each.

    Args:
        weights: float64 [k], which sum to 1.
        means, covariances: of the parts, float64 [k, m] and [k, m, m].
    """
    mean = weights @ means
    apart = means - mean
    within = np.einsum("k,kij->ij", weights, covariances)
    return mean, within + apart.T @ (weights[:, np.newaxis] * apart)


def _mixture(views: Sequence[tuple[float, RelativeView]]) -> RelativeView:
    """The views as one."""
    _, first = views[0]
    at = np.array([np.r_[_vector(view.turn @ first.turn.T), view.shift] for _, view in views])
    weights = np.array([weight for weight, _ in views])
    weights /= weights.sum()
    mean, covariance = mixture_moments(weights, at, np.array([view.covariance for _, view in views]))
    turn = _rotation(mean[:3]) @ first.turn
    return RelativeView(turn, mean[3:], covariance, min(view.inliers for _, view in views), first.source)


def _rotation(vector: Array) -> Array:
    """The rotation by a rotation vector, float64 [3, 3]."""
    return np.asarray(cv2.Rodrigues(vector)[0], np.float64)


def _vector(rotation: Array) -> Array:
    """The rotation vector of a rotation, float64 [3]."""
    return np.asarray(cv2.Rodrigues(rotation)[0][:, 0], np.float64)
