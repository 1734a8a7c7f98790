"""Two scans of a site that the model knows: each is found there by itself, so that they need not overlap.

What `fmr train` has seen of a site is kept in its model, thinned. With T_site_scan of both scans,
T_target_source = T_site_target⁻¹ T_site_source.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from fmr_cli.geometry.frames import Frame, enter_frames
from fmr_cli.geometry.se3 import adjoint
from fmr_cli.registration.confidence import ALIGNED, Judge, among
from fmr_cli.registration.looks import FINE
from fmr_cli.registration.options import Options
from fmr_cli.registration.pair import is_among, make_pair
from fmr_cli.registration.prepared import Prepared
from fmr_cli.registration.result import Registration, describe

START = "site"  # of poses that come from there
# Times smaller, that a site's deviations are on the mean, for its pose to take the place of the scans' own: what the
# site itself is off is not in them.
MORE_EXACT = 2.0
EITHER = 0.5  # the most that is left of a site's pose where the scans alone are sure of another one
APART = "registered with each other alone, the scans have another pose (confidence {:.2f}) than on a site that is known"


def asked(options: Options) -> bool:
    """Whether a pose may come by way of a site: one that is rigid, of two scans of one unit, from no given start."""
    alike = options.dof == "rigid" and not options.scale and options.unit is None
    return alike and isinstance(options.init, str) and options.init == "auto"


def there(options: Options) -> Options:
    """The options by which one scan is found on a site: what bounds the pose of the two bounds no other."""
    return replace(options, voxel_size=None, max_angle=None, max_shift=None, allow_mirror=False)


def same(scan: Prepared, a: np.ndarray, b: np.ndarray) -> bool:
    """Whether two poses (4, 4) of a scan, files' coordinates, are one but for what a refinement moves."""
    one, other = (enter_frames(T, scan.frame, Frame()) for T in (a, b))
    return is_among(one, other[None], scan.edge)


@dataclass(frozen=True)
class Placement:
    """A scan on a site: the ``Registration`` of the scan with the site as its target."""

    site: Prepared
    found: Registration


def likeliest(placements: Sequence[Placement]) -> Placement | None:
    """The one of a scan's placements, each on another site, that is most likely right, if it is ``aligned``.

    It has what the others leave of its confidence, as a scan is on one site at most.
    """
    if not placements:
        return None
    best, *others = sorted(placements, key=lambda placement: -placement.found.confidence)
    confidence = among(best.found.confidence, [other.found.confidence for other in others])
    return replace(best, found=replace(best.found, confidence=confidence)) if best.found.status == "aligned" else None


def composed(
    source: Prepared, target: Prepared, options: Options, source_there: Placement, target_there: Placement
) -> Registration | None:
    """The pose of two scans that are on one site, and what their surfaces say of it; None if it is doubtful.

    It is right where both placements are: its confidence is the product of theirs. So is its covariance their sum; what
    the site itself is off between the two places is not in it.
    """
    there, T_target_site = source_there.found, np.linalg.inv(target_there.found.T_target_source)
    confidence = there.confidence * target_there.found.confidence
    if confidence < ALIGNED or source_there.site is not target_there.site:
        return None
    pair = make_pair(source, target, options, 1, *FINE)
    T_target_source = pair.enter_centred(T_target_site @ there.T_target_source)
    if not pair.allowed(T_target_source):
        return None
    judge = Judge(pair)
    judge.consider(T_target_source, START, [])
    found = describe(pair, replace(judge.best, confidence=confidence), [], source, 1.0, options)
    A = adjoint(enter_frames(T_target_site, target_there.site.frame, target.frame))
    covariance = A @ (there.covariance + target_there.found.covariance) @ A.T
    return replace(
        found,
        status="aligned",
        covariance=covariance,
        information=np.linalg.pinv(covariance, rcond=1e-12, hermitian=True),
        undetermined=[],
        reasons=[],
    )


def believed(source: Prepared, alone: Registration, known: Registration) -> Registration:
    """Of the pose that two scans have alone, and of the one by way of a site, the one to be given.

    Where both are ``aligned`` and one, the scans' own, unless the site's is far more exact by its covariance. Where
    they are two, the site's, as each scan explains more of it than the two explain of each other; but one is wrong.
    """
    if alone.status != "aligned":
        return known
    if same(source, alone.T_target_source, known.T_target_source):
        gain = np.linalg.slogdet(known.information)[1] - np.linalg.slogdet(alone.information)[1]
        best = known if gain > 12 * np.log(MORE_EXACT) else alone  # six directions, and squares
        return replace(best, confidence=max(alone.confidence, known.confidence))
    reasons = [APART.format(alone.confidence), *known.reasons]
    return replace(known, status="uncertain", confidence=min(known.confidence, EITHER), reasons=reasons)
