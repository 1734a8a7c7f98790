"""Which hypotheses of which links hold: what cycles say, what one doubtful link may not do."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from fmr_cli.multiway.consistency import joined
from fmr_cli.multiway.denials import denials
from fmr_cli.multiway.links import Hypothesis, Link
from fmr_cli.multiway.visibility import Seen

MOMENT = np.diag([1.0, 1.0, 1.0, 1.0])
EDGE = 0.05


def pose(seed: int) -> np.ndarray:
    rng = np.random.default_rng(seed)
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = Rotation.random(random_state=rng).as_matrix(), rng.uniform(-5, 5, 3)
    return T


WORLD = [pose(n) for n in range(14)]


def link(source: int, target: int, *confidences: float, right: int | None = 0) -> Link:
    """Hypotheses of those confidences, of which number ``right`` is true."""
    true = np.linalg.inv(WORLD[target]) @ WORLD[source]
    hypotheses = [
        Hypothesis(true if k == right else pose(100 * source + 10 * target + k), c, k == 0 and c >= 0.5)
        for k, c in enumerate(confidences)
    ]
    status = "aligned" if confidences[0] >= 0.5 else "uncertain"
    return Link(source, target, status, "features", hypotheses, np.eye(6), 0.5, 0.01, EDGE)


def components(count: int, links: list[Link], overlap: float = 0.0):
    found, apart = joined(count, links, dict.fromkeys(range(count), MOMENT), lambda i, j, T: overlap)
    for component in found:
        first = min(component.T_component_scan)
        for n, T in component.T_component_scan.items():
            expected = np.linalg.inv(WORLD[first]) @ WORLD[n]
            component.right = np.allclose(np.linalg.inv(component.T_component_scan[first]) @ T, expected, atol=1e-6)
    return found, apart


def members(found):
    return [sorted(component.T_component_scan) for component in found]


def test_sure_links_join():
    found, apart = components(4, [link(1, 0, 0.9), link(2, 1, 0.9)])
    assert members(found) == [[0, 1, 2], [3]]
    assert found[0].right
    assert not apart


def test_one_doubtful_link_joins_nothing_and_is_named():
    found, apart = components(2, [link(1, 0, 0.4)])
    assert members(found) == [[0], [1]]
    assert apart[0, 1].links == (0,)
    assert apart[0, 1].probability < 0.5


def test_doubtful_links_join_nothing_however_many_agree():
    """Of two places that resemble each other, every link between them may be wrong in the same way."""
    links = [link(1, 0, 0.99), link(3, 2, 0.99), *(link(i, j, 0.45) for i in (2, 3) for j in (0, 1))]
    found, apart = components(4, links)
    assert members(found) == [[0, 1], [2, 3]]
    assert apart[0, 1].probability < 0.5, "nor does their number make it likelier"
    assert len(apart[0, 1].links) == 4
    links[2] = link(2, 0, 0.6)
    assert members(components(4, links)[0]) == [[0, 1, 2, 3]], "one is sure, and the others agree"


def test_doubtful_links_join_what_views_have_judged_and_vouch_for():
    links = [link(1, 0, 0.99), link(3, 2, 0.99), *(link(i, j, 0.45) for i in (2, 3) for j in (0, 1))]
    moments = dict.fromkeys(range(4), np.diag([90.0, 90.0, 90.0, 1.0]))
    for x in links:
        x.hypotheses[0].seen = Seen(0, 0, 100)
    for agreeing, expected in ((300, [[0, 1, 2, 3]]), (100, [[0, 1], [2, 3]])):  # points, of each pair that meets

        def views(pairs, agreeing=agreeing):
            return [Seen(0, 0, agreeing) for _ in pairs]

        assert members(joined(4, links, moments, lambda i, j, T: 0.0, seen=views)[0]) == expected


def test_a_doubtful_rival_is_no_likelier_for_many_that_agree():
    """A sure link says one thing, four doubtful ones of another place together something else."""
    shift = np.eye(4)
    shift[:3, 3] = 3.0
    wrong = []
    for i, j in ((2, 1), (3, 0), (3, 1), (2, 0)):
        x = link(i, j, 0.4)
        x.hypotheses[0].T_target_source = np.linalg.inv(WORLD[j]) @ shift @ WORLD[i]
        wrong.append(x)
    sure = link(2, 0, 0.76)
    sure.hypotheses.append(wrong.pop().hypotheses[0])
    found, _ = components(4, [link(1, 0, 0.99), link(3, 2, 0.99), sure, *wrong])
    assert members(found) == [[0, 1, 2, 3]]
    assert found[0].right


def test_a_few_sure_links_between_places_alike_do_not_outweigh_the_many_that_find_nothing():
    """Two streets of seven scans: five links between them are sure, and wrong in the same way; 44 pairs don't fit."""
    shift = np.eye(4)
    shift[:3, 3] = 3.0
    across = [link(i, j, 0.8) if (i + 3 * j) % 10 == 0 else link(i, j, 0.01, right=None)
              for i in range(7, 14) for j in range(7)]  # fmt: skip
    for x in across:
        if x.status == "aligned":
            x.hypotheses[0].T_target_source = np.linalg.inv(WORLD[x.target]) @ shift @ WORLD[x.source]
    chains = [link(n + 1, n, 0.99) for n in range(13) if n != 6]
    assert sum(x.status == "aligned" for x in across) == 5
    assert members(components(14, [*chains, *across], overlap=0.0)[0]) == [[*range(14)]], "if they would not overlap"
    assert members(components(14, [*chains, *across], overlap=0.4)[0]) == [[*range(7)], [*range(7, 14)]]


def test_a_denial_weighs_as_much_as_pairs_that_overlap_are_seldom_missed():
    """Of fifteen pairs of six scans that overlap by half, as a third scan tells, so many were not found."""

    def six(missed):
        pairs = [(i, j) for i in range(6) for j in range(i)]
        links = [link(i, j, 0.01, right=None) if n < missed else link(i, j, 0.9) for n, (i, j) in enumerate(pairs)]
        return denials(links, dict.fromkeys(range(6), MOMENT), lambda i, j, T: 0.6, set()).sought

    (half, seldom), (third, prior) = six(0)
    assert (half, third) == (0.5, 0.3)
    assert seldom == pytest.approx(-np.log(0.5 / 25))
    assert prior == pytest.approx(np.log(3)), "of pairs that overlap less nothing is known"
    assert six(3)[0][1] == pytest.approx(-np.log(3.5 / 25))


def test_a_wrong_link_that_nothing_confirms_does_not_make_pairs_look_missed():
    links = [link(1, 0, 0.99), link(2, 1, 0.99), link(3, 2, 0.99, right=None), link(3, 1, 0.01), link(3, 0, 0.01)]
    counted = denials(links, dict.fromkeys(range(4), MOMENT), lambda i, j, T: 0.6, set()).sought
    assert counted[0][1] == pytest.approx(-np.log(0.05))


def test_a_pair_tried_from_its_pose_denies_more_and_confirms_less():
    """Between places that look alike: what begins at the pose ends there, if it fits at all."""
    chains, across = [link(1, 0, 0.99), link(3, 2, 0.99)], [link(2, 0, 0.8), link(3, 1, 0.8)]
    silent = [link(3, 0, 0.001), link(2, 1, 0.001)]
    for x in silent:
        x.hypotheses[0].T_target_source[:3, 3] += 0.3  # six voxel edges from where the others have it
        x.start = "look"
    links = [*chains, *across, *silent]
    assert members(components(4, links, overlap=0.4)[0]) == [[0, 1, 2, 3]]
    silent[0].start = silent[1].start = "pose"
    assert members(components(4, links, overlap=0.4)[0]) == [[0, 1], [2, 3]]
    for x in silent:
        x.hypotheses[0].T_target_source[:3, 3] += 5.0
    assert members(components(4, links, overlap=0.4)[0]) == [[0, 1, 2, 3]], "from another pose, which says little here"
    silent[0].hypotheses[0].T_target_source[:3, 3] -= 5.0
    across = [link(2, 0, 0.6), link(3, 1, 0.6)]
    links = [*chains, *across, silent[0]]
    assert members(components(4, links, overlap=0.4)[0]) == [[0, 1, 2, 3]]
    across[0].start = across[1].start = "pose"
    assert members(components(4, links, overlap=0.4)[0]) == [[0, 1], [2, 3]]


def test_a_cycle_chooses_among_the_poses_of_an_ambiguous_link():
    ambiguous = link(2, 0, 0.5, 0.45, right=1)  # a place that repeats itself: the wrong pose looks a little better
    found, _ = components(3, [link(1, 0, 0.95), link(2, 1, 0.95), ambiguous])
    assert members(found) == [[0, 1, 2]]
    assert found[0].right


def test_an_ambiguous_link_alone_joins_nothing():
    assert members(components(2, [link(1, 0, 0.48, 0.47)])[0]) == [[0], [1]]


def test_a_wrong_link_made_first_is_outvoted():
    wrong = link(3, 0, 0.9999, right=None)
    links = [link(1, 0, 0.9), link(2, 1, 0.9), link(2, 0, 0.9), link(3, 1, 0.9), link(3, 2, 0.9), wrong]
    found, _ = components(4, links)
    assert members(found) == [[0, 1, 2, 3]]
    assert found[0].right


def test_of_two_links_that_contradict_each_other_and_are_as_sure_neither_joins():
    """Scan 0 hangs on one link alone, which was taken first; another one has it elsewhere: nothing tells which errs."""
    ring = [link(2, 1, 0.99), link(3, 2, 0.99), link(4, 3, 0.99), link(4, 1, 0.99)]
    found, apart = components(5, [*ring, link(1, 0, 0.99), link(3, 0, 0.99, right=None)])
    assert members(found) == [[1, 2, 3, 4], [0]]
    assert found[0].right
    assert apart[0, 1].probability == pytest.approx(0.5)
    found, _ = components(5, [*ring, link(1, 0, 0.99), link(3, 0, 0.6, right=None)])
    assert members(found) == [[0, 1, 2, 3, 4]], "one is far surer than the other"
    found, _ = components(5, [*ring, link(1, 0, 0.99), link(2, 0, 0.99), link(3, 0, 0.99, right=None)])
    assert members(found) == [[0, 1, 2, 3, 4]], "two against one"
    assert found[0].right


def test_pairs_that_would_overlap_and_do_not_fit_deny_a_join():
    base = [link(1, 0, 0.99), link(3, 2, 0.99), link(2, 0, 0.8)]
    silent = Link(3, 1, "uncertain", "pose", [Hypothesis(pose(77), 0.001)], np.eye(6), 0.1, 0.01, EDGE)
    assert members(components(4, [*base, silent], overlap=0.0)[0]) == [[0, 1, 2, 3]]
    found, apart = components(4, [*base, silent], overlap=0.9)
    assert members(found) == [[0, 1], [2, 3]]
    assert apart[0, 1].denied == 1


def test_what_views_contradict_is_not_joined_but_for_a_link_that_is_given():
    links = [link(1, 0, 0.99), link(3, 2, 0.99), link(2, 0, 0.9)]

    def blocked(pairs):
        """Scans 0 and 1 see through 2 and 3."""
        return [Seen(100, 0, 900) if (i < 2) != (j < 2) else Seen(0, 0, 900) for i, j, _ in pairs]

    moments = dict.fromkeys(range(4), np.diag([9.0, 9.0, 9.0, 1.0]))
    for x in links:  # views tell, since each scan's best link is in line with them
        x.hypotheses[0].seen = Seen(0, 0, 1000)
    assert members(joined(4, links, moments, lambda i, j, T: 0.0)[0]) == [[0, 1, 2, 3]]
    found, apart = joined(4, links, moments, lambda i, j, T: 0.0, seen=blocked)
    assert members(found) == [[0, 1], [2, 3]]
    assert apart[0, 1].denied > 0
    links[2].start = "known"
    assert members(joined(4, links, moments, lambda i, j, T: 0.0, seen=blocked)[0]) == [[0, 1, 2, 3]]


def test_a_pose_that_views_forbid_makes_room_for_the_next_best():
    """Of two poses between the same scans the more confident one brings scans together that contradict each other."""
    right, wrong = link(2, 0, 0.9), link(3, 1, 0.99, right=None)
    links = [link(1, 0, 0.99), link(3, 2, 0.99), right, wrong]
    for x in links:
        x.hypotheses[0].seen = Seen(0, 0, 1000)

    def views(pairs):
        """Contradiction wherever scans 0 and 2 are not where they belong."""
        found = []
        for i, j, T in pairs:
            at_home = np.allclose(T, np.linalg.inv(WORLD[j]) @ WORLD[i], atol=1e-6)
            found.append(Seen(0, 0, 900) if at_home else Seen(100, 0, 900))
        return found

    moments = dict.fromkeys(range(4), np.diag([99.0, 99.0, 99.0, 1.0]))
    found, _ = joined(4, links, moments, lambda i, j, T: 0.0, seen=views)
    assert members(found) == [[0, 1, 2, 3]]
    T = found[0].T_component_scan
    assert np.allclose(np.linalg.inv(T[0]) @ T[2], np.linalg.inv(WORLD[0]) @ WORLD[2], atol=1e-6)


def test_where_rooms_resemble_each_other_links_that_agree_say_little():
    """As many of the sure poses are ruled out by views as in a building of like rooms: agreement says little there."""

    def doubtful(ruled_out):
        links = [link(1, 0, 0.99), link(3, 2, 0.99), link(2, 0, 0.4), link(3, 1, 0.4)]
        alike = [link(5, n, 0.99, right=None) for n in range(4)] + [link(4, n, 0.99, right=None) for n in range(4)]
        for x, agreeing in zip(
            links, (1000, 1000, 0, 0), strict=True
        ):  # of the doubtful ones views have nothing to say
            x.hypotheses[0].seen = Seen(0, 0, agreeing)
        for x in alike:
            x.hypotheses[0].seen = Seen(100, 0, 1000) if ruled_out else Seen(0, 0, 1000)
        for n in range(2):  # so that views tell of 4 and 5, too
            links.append(link(4 + n, n, 0.02))
            links[-1].hypotheses[0].seen = Seen(0, 0, 1000)
            links[-1].hypotheses[0].aligned = True
        every = links if not ruled_out else [*links, *alike]
        _, apart = joined(6, every, dict.fromkeys(range(6), MOMENT), lambda *_: 0.0)
        return max(join.probability for join in apart.values() if {2, 3}.intersection(join.links))

    assert doubtful(False) > 0.8
    assert doubtful(True) < 0.6


def test_views_confirm_a_link_that_align_is_shy_of_unless_it_leaves_a_direction_open():
    def found(firm: bool, seen: Seen):
        links = [link(1, 0, 0.99), link(3, 2, 0.99), link(2, 0, 0.05)]
        for x in links[:2]:
            x.hypotheses[0].seen = Seen(0, 0, 1000)
        links[2].hypotheses[0].seen, links[2].hypotheses[0].firm = seen, firm
        return members(components(4, links)[0])

    assert found(True, Seen(0, 0, 1000)) == [[0, 1, 2, 3]]
    assert found(False, Seen(0, 0, 1000)) == [[0, 1], [2, 3]]
    assert found(True, Seen(0, 0, 300)) == [[0, 1], [2, 3]], "too few points to say so"
    assert found(True, Seen(8, 0, 1000)) == [[0, 1], [2, 3]], "something is seen through"
    assert found(True, Seen(0, 400, 1000)) == [[0, 1], [2, 3]], "a wall from its two sides"
    assert found(True, Seen(0, 0, 0, hidden=0.2)) == [[0, 1], [2, 3]], "no viewpoint explains one of the scans"
