"""Scan by scan into the frame of the first: predict, align to a local map, judge, and only then add to the map.

All lengths in here are in voxels: the clouds are shifted to the first scan's centre and divided by a voxel edge that
the first scan's own density gives (``voxel_frame``). So every constant below holds for a Kinect as for a LiDAR, in
metres as in millimetres, and far from the origin. Everything runs in a fixed order on one thread, so that a run can be
repeated bit for bit.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from fmr_cli.cloud import transform_points
from fmr_cli.errors import RegistrationError
from fmr_cli.geometry.observability import about, in_frame, weak_twists
from fmr_cli.registration.confidence import ALIGNED
from fmr_cli.registration.options import Options
from fmr_cli.sequence.feature_error import feature_errors
from fmr_cli.sequence.frame import Frame
from fmr_cli.sequence.inner_motion import without_motion
from fmr_cli.sequence.known_map import KnownMap
from fmr_cli.sequence.local_map import COARSE, FINE, WIDE, Fit, LocalMap, displacement
from fmr_cli.sequence.motion_model import Expected, MotionModel, Told
from fmr_cli.sequence.moving_scan import MovingScan
from fmr_cli.sequence.prepared_scan import PreparedScan
from fmr_cli.sequence.voxel_frame import VoxelFrame

if TYPE_CHECKING:
    from fmr_cli.registration import Registration

# The constants without a reference are set by hand on the drives of the tests (a simulated street; HDL-64 and Kinect
# sequences): whole numbers and halves, none of them tuned to a decimal.

KEYFRAME_MOTION = 8.0  # voxels that the points have moved since the last keyframe, on average ...
KEYFRAME_RISE = 1.5  # ... or so many times its ``total`` right after it: then the scan joins the map
# A scan that fits has 0.7 to 0.95 of its points on the map at a mean cost of 0.3 to 0.7 (see ``Fit``), whatever the
# sensor; beyond these a fit is no fit.
MIN_OVERLAP, MAX_COST = 0.35, 3.0
OVERLAP_DROP = 0.5  # of the running median of overlaps, at least
DOUBTFUL_OVERLAP, DOUBTFUL_TOTAL = 0.85, 1.25  # against the running medians: beyond, more starts are tried
CONVINCING = 2.3  # a ``total`` for which one start is enough; right poses have up to 2.1, wrong ones from 2.9
FALLEN = 0.7  # of the usual overlap: below it the registration onto the scan before is asked, whatever the starts say
STRIKING = 1.5  # times the usual ``total``: beyond it one start is not enough
TRUSTED_AFTER = 2  # aligned frames in a row, after which the prediction alone may do
EXPECTED_ERROR = 3  # times the largest of the last prediction errors: so far may the next one be off
# Times the distance from the map's planes, beyond which a scan held at the prediction does not fit there. In made-up
# tunnels and before blank walls it comes to 1.04 at most, wherever along them the scan is held.
WORSE = 1.1
# Voxels, of the same distance: below it what differs is how a scanner's pattern lies in the voxels of a curved wall.
FINEST = 0.05
# Voxels: an unobserved direction whose sigma is beyond it could matter. Half the voxel that everything here is measured
# by: 0.05 m for a depth camera in a room, 0.2 m for a LiDAR in a street.
MATTERS = 0.5
# Voxels along an unobserved direction, to either side: from there starts find back to one pose, to within SAME voxels,
# where more shows it than normals tell, as trunks and leaves do. In tunnels and before blank walls they stay where they
# are, or go back to where a keyframe stood.
ASIDE, SAME = 2.0, 0.1
# How reliable what they come back to must be, where normals are believed (``Observability.hint``). By hand: in made-up
# pans over a blank wall (6 to 18 deg a frame), slides along one, corridors and tunnels all such poses were right,
# within 0.04 voxels at hints above 0.35, 0.12 at 0; too few to tell where between the two a limit belongs.
HINTED = 1 / 3
# Times the ``total`` of a pose by features that is neither sure nor usual: what is hardly better is no reason to leap.
# A wrong one, at a corridor's corner behind a door, was better by 1.03, a right one after a gap of 10 m by 1.28.
CLEARLY = 1.2
ABOUT_AS_WELL = 1.5  # times the ``total`` of a pose that leaves directions open, for one that leaves none
LOST_AFTER = 3  # uncertain frames in a row, after which the map is begun anew at the prediction
ERRORS_KEPT, FITS_KEPT = 5, 15  # frames that running figures look back over


class Odometry:
    """Registers scans, in their order, into the frame of the first one, or into that of a known map.

    pair: how a scan is registered onto the one before it, or found in the known map.
    """

    def __init__(self, frame: VoxelFrame, known: KnownMap | None = None, pair: Options = Options()) -> None:
        self.frame, self.known, self.pair = frame, known, pair
        self.map = LocalMap(known)
        self.motion: MotionModel | None = None  # from the first scan on
        self.last: tuple[int, PreparedScan, np.ndarray]  # index, scan, T_map_scan: the last one that could be used
        self.aligned = self.uncertain = 0  # frames in a row
        self.errors: deque[float] = deque(maxlen=ERRORS_KEPT)  # voxels, of the last predictions
        self.usual: deque[tuple[float, float]] = deque(maxlen=FITS_KEPT)  # overlap and total of aligned frames
        self.slopes: deque[float] = deque(maxlen=FITS_KEPT)  # see ``plane_map.trust``
        self.by_features: tuple[int, PreparedScan, Registration] | None = None  # the last scan onto that one
        self.best_total = np.inf  # of the fits since the last keyframe
        self.index = 0

    def register(
        self, scan: PreparedScan | None, told: Told | None = None, pace: float = 1.0, moving: MovingScan | None = None
    ) -> Frame:
        """The next frame; None stands for a scan that could not be used, and is bridged by the prediction.

        told: what is known of the motion from the frame before. pace: the time since then over that before it. moving:
        what the scan was made of, where it was deskewed; it is made anew as the motion within it becomes known.
        Raises RegistrationError where it is the first one.
        """
        index, self.index = self.index, self.index + 1
        if self.motion is None:
            return replace(self._begin(index, scan, np.eye(4)), moving=moving)
        expected = self.motion.expect(told, pace)
        if scan is None:
            return self._bridge(index, None, expected, Fit(expected.T_map_scan, 0.0, np.nan, "prediction"))
        _, last, T_map_last = self.last
        fit = self._best_fit(scan, expected) if moving is None else self._first_look(scan, expected)
        if moving and self._fits(fit):
            information = self.motion.information_within(moving.share)
            scan, moving = without_motion(self.map, scan, moving, fit, self._usual_slope(), information)
            fit = self._best_fit(scan, expected)
        if self._fits(fit):
            fit = self._polished(scan, fit, expected)
            self._accept(index, scan, expected, fit)
            frame = self._frame(fit)
        else:
            frame = self._bridge(index, scan, expected, fit)
        T_last_scan = np.linalg.inv(T_map_last) @ self.motion.T_map_scan
        errors = feature_errors(last, scan, T_last_scan, self.pair.model)
        return replace(frame, feature_errors=errors, moving=moving)

    def begin_in_map(self, scan: PreparedScan | None, T_map_guess: np.ndarray | None) -> Frame:
        """The first frame, in the known map: near a guess (4, 4), or found by registration.

        Raises RegistrationError where it isn't found.
        """
        index, self.index = self.index, self.index + 1
        return self._begin(index, scan, self._place(scan, T_map_guess) if scan else np.eye(4))

    def _place(self, scan: PreparedScan, T_map_guess: np.ndarray | None) -> np.ndarray:
        assert self.known
        if T_map_guess is None:
            T_map_guess, why = self.known.locate(scan, self.pair)
            if T_map_guess is None:
                raise RegistrationError(f"is not found in the map ({why}); give its pose with --init-poses")
        fit = self.map.fit(scan, T_map_guess, (WIDE, COARSE, FINE), "given")
        if not self._fits(fit):
            raise RegistrationError(
                f"does not fit the map where it is said to be (overlap {fit.overlap:.2f}); correct its pose"
            )
        return self.map.polish(scan, fit, 0.0)[0].T_map_scan

    def _begin(self, index: int, scan: PreparedScan | None, T_map_scan: np.ndarray) -> Frame:
        if scan is None:
            raise RegistrationError("the first scan has too few points to start from, leave it out with --start")
        self.map.insert(index, scan, T_map_scan)
        self.motion = MotionModel(T_map_scan, float(np.sqrt((scan.ranges**2).mean())))
        self.last, self.aligned = (index, scan, T_map_scan), 1
        return Frame(self.frame.pose_to_file(T_map_scan), "aligned", 1.0, 0.0, "first")

    def _best_fit(self, scan: PreparedScan, next_frame: Expected) -> Fit:
        """Trust the prediction while predictions have been good; else compare starts by what they come to.

        Where none fits the map, the registration onto the scan before counts, if its verdict is "aligned".
        """
        T_map_predicted, expected = next_frame.T_map_scan, EXPECTED_ERROR * max(self.errors, default=np.inf)
        # The widest level reaches far, and slides along a street: it only ever competes with the narrower ones.
        levels = (FINE,) if expected < FINE else (COARSE, FINE)
        if self.aligned > TRUSTED_AFTER:
            fit = self.map.fit(scan, T_map_predicted, levels, "prediction", few=True)
            if self._usual(fit) and displacement(fit.T_map_scan, T_map_predicted, scan.points) < expected + COARSE:
                return fit
        fits = [self.map.fit(scan, T_map_predicted, levels, "prediction")]
        assert self.motion
        starts = {"zero-motion": self.motion.T_map_scan}
        if self.motion.begun or next_frame.told:
            starts = {"prediction": T_map_predicted, **starts}
        fits += [self.map.fit(scan, T, (WIDE, COARSE, FINE), name) for name, T in starts.items()]
        best = min(fits, key=lambda fit: fit.total)
        same = all(displacement(fit.T_map_scan, best.T_map_scan, scan.points) < FINE / 2 for fit in fits)
        if self._fits(best) and not self._fallen(best) and ((len(fits) > 1 and same) or self._convincing(best)):
            return best
        found, T_map_features = self._by_features(scan)
        by_features = self.map.fit(scan, T_map_features, (COARSE, FINE), "features")
        sure = found.status == "aligned"
        if not (sure or self._fits(best)):
            sure = self._borne_out(scan, T_map_features, by_features)
        if not sure:
            # A leap that nothing vouches for: a passage's corner fits another one in several ways.
            clearly = CLEARLY if self.usual and not self._usual(by_features) else 1.0
            if clearly * by_features.total >= best.total:
                return best
            leapt = all(displacement(by_features.T_map_scan, fit.T_map_scan, scan.points) > FINE for fit in fits)
            return replace(by_features, doubtful=leapt)
        best = min(best, by_features, key=lambda fit: fit.total)
        if not self._fits(best):
            best = by_features
        if displacement(best.T_map_scan, T_map_features, scan.points) > FINE:
            return best if self._fits(best) else replace(by_features, T_map_scan=T_map_features, verified=True)
        return replace(best, verified=True)

    def _first_look(self, scan: PreparedScan, expected: Expected) -> Fit:
        """Where a scan is by the prediction, if that leads to the map: near enough to tell the motion within it."""
        if self.aligned > TRUSTED_AFTER:
            fit = self.map.fit(scan, expected.T_map_scan, (COARSE, FINE), "prediction", few=True)
            if self._fits(fit):
                return fit
        return self._best_fit(scan, expected)

    def _usual_slope(self) -> float:
        return float(np.median(self.slopes)) if self.slopes else 0.0

    def _by_features(self, scan: PreparedScan) -> tuple[Registration, np.ndarray]:
        """The registration onto the last scan that could be used, and where that puts the scan in the map."""
        from fmr_cli.registration import align

        index, last, T_map_last = self.last
        if self.by_features is None or self.by_features[:2] != (index, scan):  # asked twice at a doubtful frame
            found = align(scan.for_align, last.for_align, replace(self.pair, init="features"), hints=False)
            self.by_features = index, scan, found
        found = self.by_features[2]
        return found, T_map_last @ found.T_target_source

    def _borne_out(self, scan: PreparedScan, T_map_features: np.ndarray, fit: Fit) -> bool:
        """Whether all points of a scan and of the last one put it where their thinned ones do, and surely.

        Of two scans across a gap, thinning may leave hardly more than a corner in common, which fits any other. In
        corridors all points alone are no surer: both must say the same. What the two do not determine is no doubt where
        the map does. fit: of the scan onto the map, from T_map_features.
        """
        from fmr_cli.registration import align

        _, last, T_map_last = self.last
        source, target = scan.whole_for_align(), last.whole_for_align()
        found = align(source, target, replace(self.pair, init="features"), hints=False)
        T_map_scan = T_map_last @ found.T_target_source
        if found.confidence < ALIGNED or displacement(T_map_scan, T_map_features, scan.points) > FINE:
            return False
        if found.status == "aligned":
            return True
        fit, _ = self.map.polish(scan, fit, 0.0)
        if fit.seen is None or displacement(fit.T_map_scan, T_map_scan, scan.points) > FINE:
            return False
        of_pair = about(in_frame(about(found.information, -found.origin), T_map_last), fit.seen.centre)
        weak = weak_twists(of_pair, transform_points(fit.T_map_scan, scan.points) - fit.seen.centre)
        of_map = np.linalg.eigvalsh(weak.T @ fit.seen.information @ weak)
        return bool(of_map.min(initial=np.inf) > MATTERS**-2)

    def _remember(self, index: int, scan: PreparedScan, T_map_scan: np.ndarray) -> None:
        """This is the scan before the next one; nobody will ask again for the one before it."""
        self.last, self.by_features = (index, scan, T_map_scan), None

    def _fits(self, fit: Fit) -> bool:
        usual = float(np.median([overlap for overlap, _ in self.usual])) if self.usual else 0.0
        return fit.verified or (fit.overlap >= max(MIN_OVERLAP, OVERLAP_DROP * usual) and fit.cost <= MAX_COST)

    def _fallen(self, fit: Fit) -> bool:
        """Whether so little of the scan has a counterpart that starts which agree may all be wrong."""
        return bool(self.usual) and fit.overlap < FALLEN * float(np.median([overlap for overlap, _ in self.usual]))

    def _convincing(self, fit: Fit) -> bool:
        """Whether a pose that one start alone has found needs no other opinion."""
        usual = float(np.median([total for _, total in self.usual])) if self.usual else np.inf
        return fit.total < min(CONVINCING, STRIKING * usual)

    def _usual(self, fit: Fit) -> bool:
        """Whether the fit is as good as the last ones; a scanner's rings on the ground hold it where it was, too."""
        overlap, total = np.median(self.usual, axis=0)
        return self._fits(fit) and fit.overlap > DOUBTFUL_OVERLAP * overlap and fit.total < DOUBTFUL_TOTAL * total

    def _polished(self, scan: PreparedScan, fit: Fit, expected: Expected) -> Fit:
        """The fit's exact pose; along directions that are not observed, the prediction's.

        Four things can show that such a direction is observed after all: a pose further off fits and is observed in
        all directions; starts on either side find back to one pose; the scan does not fit at the prediction; or there
        all of it is observed.
        """
        assert self.motion
        usual_slope = self._usual_slope()
        found, (fit, slope) = fit, self.map.polish(scan, fit, usual_slope)
        if np.isfinite(slope):
            self.slopes.append(slope)
        if fit.verified:  # by the scan before, whatever little the map has there
            same = fit.seen is not None and displacement(fit.T_map_scan, found.T_map_scan, scan.points) < FINE
            return replace(fit, seen=fit.seen.as_observed()) if fit.seen and same else replace(found, rms=fit.rms)
        if fit.seen is None or fit.seen.observed.all():
            return fit
        elsewhere = self._observed_elsewhere(scan, fit, expected, usual_slope)
        if elsewhere is not None:
            return elsewhere
        held = replace(fit, T_map_scan=self.motion.combined(fit.T_map_scan, expected, fit.seen))
        for middle in [fit, held] if fit.seen.hint >= HINTED else [held]:
            between = self._found_from_both_sides(scan, middle, usual_slope)
            if between is not None:
                return between
        there, _ = self.map.polish(scan, held, usual_slope)
        if there.seen is None:
            return replace(held, seen=fit.seen)
        if there.seen.observed.all():
            return there
        if there.rms > WORSE * max(fit.rms, FINEST):
            return replace(fit, seen=fit.seen.as_observed())
        return replace(there, T_map_scan=self.motion.combined(there.T_map_scan, expected, there.seen))

    def _observed_elsewhere(self, scan: PreparedScan, fit: Fit, expected: Expected, slope: float) -> Fit | None:
        """A pose found from further off that fits about as well and leaves nothing open.

        A scanner's rings on the ground hold a scan where it was, where what faces its motion fits nothing. The first
        motion of all, or one after a gap, may be further than any level of the map reaches: where the fit is not as
        good as usual, the scan before is asked.
        """
        others = [self.map.fit(scan, expected.T_map_scan, (WIDE, COARSE, FINE), fit.start)]
        if not expected.told and not (self.usual and self._usual(fit)):
            found, T_map_features = self._by_features(scan)
            if found.status == "aligned":
                others.append(self.map.fit(scan, T_map_features, (COARSE, FINE), "features"))
        for other in others:
            if not self._fits(other) or other.total > ABOUT_AS_WELL * fit.total:
                continue
            if displacement(other.T_map_scan, fit.T_map_scan, scan.points) < FINE:
                continue
            other, _ = self.map.polish(scan, other, slope)
            if other.seen is not None and other.seen.observed.all():
                return other
        return None

    def _found_from_both_sides(self, scan: PreparedScan, middle: Fit, slope: float) -> Fit | None:
        """The one pose to which starts ASIDE of the middle along every unobserved direction come back.

        Not where a keyframe stood: the scanner's own pattern brings a scan back to there.
        """
        assert middle.seen
        found: Fit | None = None
        for start in middle.seen.aside(middle.T_map_scan, ASIDE):
            fit = self.map.fit(scan, start, (COARSE, FINE), middle.start)
            fit, _ = self.map.polish(scan, fit, slope)
            if fit.seen is None or fit.seen.hint < HINTED or not self._fits(fit):
                return None
            if displacement(fit.T_map_scan, (found or fit).T_map_scan, scan.points) > SAME:
                return None
            found = found or fit
        if found is None or found.seen is None or self.map.moved(scan, found.T_map_scan) < FINE:
            return None
        return replace(found, seen=found.seen.as_observed())

    def _accept(self, index: int, scan: PreparedScan, expected: Expected, fit: Fit) -> None:
        """Take the fit as the pose, and the scan into the map where it has moved on or the map has grown stale."""
        assert self.motion
        if self.motion.begun:
            self.errors.append(displacement(fit.T_map_scan, expected.T_map_scan, scan.points))
        self.usual.append((fit.overlap, fit.total))
        self.aligned, self.uncertain = self.aligned + 1, 0
        self.motion.advance(fit.T_map_scan, expected, fit.seen)
        self._remember(index, scan, fit.T_map_scan)
        self.best_total = min(self.best_total, fit.total)
        moved = displacement(fit.T_map_scan, self.map.keyframes[-1].T_map_scan, scan.points)
        if fit.total > KEYFRAME_RISE * self.best_total or moved > KEYFRAME_MOTION:
            self.map.insert(index, scan, fit.T_map_scan)
            self.best_total = np.inf

    def _bridge(self, index: int, scan: PreparedScan | None, expected: Expected, fit: Fit) -> Frame:
        """Go on at the prediction; where that lasts, with a new map, or elsewhere in the known one."""
        self.aligned, self.uncertain = 0, self.uncertain + 1
        assert self.motion
        T_map_scan = expected.T_map_scan
        self.motion.advance(T_map_scan, expected, None)
        if scan is not None:
            self._remember(index, scan, T_map_scan)
            if self.uncertain >= LOST_AFTER:
                self._begin_again(index, scan)
        T_first_scan = self.frame.pose_to_file(self.motion.T_map_scan)
        return Frame(T_first_scan, "uncertain", fit.overlap, fit.rms * self.frame.voxel, fit.start)

    def _begin_again(self, index: int, scan: PreparedScan) -> None:
        """The old map is out of sight: what follows is at least right in itself. A known map is looked for."""
        assert self.motion
        T_map_scan = self.motion.T_map_scan
        if self.known:
            found, _ = self.known.locate(scan, self.pair)
            T_map_scan = T_map_scan if found is None else found
        self.map, self.uncertain, self.best_total = LocalMap(self.known), 0, np.inf
        self.map.insert(index, scan, T_map_scan)
        self.usual.clear()
        self.motion.forget_place(T_map_scan)
        self._remember(index, scan, T_map_scan)

    def _frame(self, fit: Fit) -> Frame:
        """What came of a scan that fits."""
        assert self.motion
        T_first_scan = self.frame.pose_to_file(fit.T_map_scan)
        status = "uncertain" if fit.doubtful else "aligned"
        found = Frame(T_first_scan, status, fit.overlap, fit.rms * self.frame.voxel, fit.start)
        if fit.seen is None or fit.seen.observed.all():
            return found
        rotation, shift = self.motion.sigma(fit.seen.centre)
        unclear = max(rotation * fit.seen.radius, shift) > MATTERS
        return replace(
            found, status="uncertain" if unclear else status,
            unobserved=tuple(fit.seen.unobserved),
            sigma_shift=shift * self.frame.voxel, sigma_rotation=float(np.degrees(rotation)),
        )  # fmt: skip

    @property
    def T_map_scan(self) -> np.ndarray:  # noqa: N802
        """(4, 4): the last frame's pose."""
        assert self.motion
        return self.motion.T_map_scan

    def state(self) -> dict[str, Any]:
        """What ``restore`` needs besides every frame's T_map_scan; JSON types."""
        assert self.motion
        return {
            "motion": self.motion.state(),
            "aligned": self.aligned,
            "uncertain": self.uncertain,
            "errors": list(self.errors),
            "usual": list(self.usual),
            "slopes": list(self.slopes),
            "best_total": self.best_total,
            "last": self.last[0],
            "map": [keyframe.index for keyframe in self.map.keyframes],
        }

    def restore(self, state: dict[str, Any], T_map_scan: list[np.ndarray], load: Callable[[int], PreparedScan]) -> None:
        """Go on exactly as after the frame that ``state`` was taken at.

        T_map_scan: (4, 4) of every frame so far; load: gives a frame's scan as it was registered.
        """
        self.index, self.motion = len(T_map_scan), MotionModel.restored(state["motion"])
        self.aligned, self.uncertain, self.best_total = state["aligned"], state["uncertain"], state["best_total"]
        self.errors.extend(state["errors"])
        self.usual.extend((overlap, total) for overlap, total in state["usual"])
        self.slopes.extend(state["slopes"])
        for index in state["map"]:
            self.map.insert(index, load(index), T_map_scan[index])
        self.last = (state["last"], load(state["last"]), T_map_scan[state["last"]])
