"""Many scans in any order with exact truth: a building whose rooms resemble each other, and a long street.

    python -m benchmarks.multiway building --out /tmp/building     # 40 terrestrial scans, 2 mm of noise
    python -m benchmarks.multiway street --out /tmp/street         # 200 scans of a spinning LiDAR: cost
    python -m benchmarks.multiway wrong                            # ten networks, a tenth of their links made wrong

Scans are made once per --out and kept there, each turned by any rotation. Said of each run: scans placed, placed
wrongly (over 5 deg or 0.1 m off), position errors of the pose graph alone and after the joint refinement (about the
best common frame), the sigmas that were given, links, seconds, memory.
"""

from __future__ import annotations

import argparse
import json
import resource
import subprocess
import sys
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from fmr_cli import PointCloud, align_many, write_cloud
from fmr_cli.cloud import angle_degrees
from fmr_cli.multiway.known import Known, KnownLink
from fmr_cli.multiway.network import Network
from fmr_cli.synthetic.scenes import CUBE, CYLINDER, Scene, lidar_rays, scan, street

NOISE = 0.002  # m, of a terrestrial scanner's ranges
HEIGHT, WALL, DOOR, DOOR_HEIGHT = 2.8, 0.15, 0.9, 2.1  # of the building, m
ROOM, DEPTH, CORRIDOR = 5.4, 4.8, 2.2  # along the corridor, away from it, across it
WRONG_DEGREES, WRONG_SHIFT = 5.0, 0.1


def wall(scene: Scene, start: np.ndarray, end: np.ndarray, doors: tuple[float, ...] = ()) -> None:
    """A wall from start to end (x, y), along x or y, with open doors whose middles lie so far along it."""
    length = float(np.linalg.norm(end - start))
    u = (end - start) / length
    half_across = WALL / 2 * np.abs(u[::-1])

    def piece(a: float, b: float, low: float, high: float) -> None:
        middle = start + u * (a + b) / 2
        half = np.abs(u) * (b - a) / 2 + half_across
        scene.add(CUBE, [*middle, (low + high) / 2], [*half, (high - low) / 2])

    at = 0.0
    for door in doors:
        piece(at, door - DOOR / 2, 0, HEIGHT)
        piece(door - DOOR / 2, door + DOOR / 2, DOOR_HEIGHT, HEIGHT)
        at = door + DOOR / 2
    piece(at, length, 0, HEIGHT)


def furnish(scene: Scene, rng: np.random.Generator, corner: np.ndarray, size: np.ndarray, inward: int) -> None:
    """An office like its neighbours: desk, cupboards and shelves in their usual places; things on them."""
    x0, y0 = corner
    back = y0 + (size[1] if inward > 0 else 0)
    away = -inward
    desk = np.array([x0 + 1.4 + rng.normal(0, 0.15), back + away * (0.55 + abs(rng.normal(0, 0.1)))])
    turn = Rotation.from_euler("z", rng.normal(0, 0.05))
    scene.add(CUBE, [*desk, 0.73], [0.8, 0.4, 0.02], turn)
    for sx in (-1, 1):
        scene.add(CUBE, [*(desk + turn.apply([0.75 * sx, 0, 0])[:2]), 0.36], [0.03, 0.36, 0.36], turn)
    for _ in range(rng.integers(1, 5)):
        at = desk + turn.apply([*rng.uniform([-0.7, -0.3], [0.7, 0.3]), 0])[:2]
        half = rng.uniform(0.05, 0.2, 3)
        scene.add(CUBE, [*at, 0.75 + half[2]], half, Rotation.from_euler("z", rng.uniform(0, 6)))
    width = rng.choice([0.4, 0.6])
    scene.add(CUBE, [x0 + size[0] - width - 0.1, back + away * 0.25, 0.9], [width, 0.2, 0.9])
    for _ in range(rng.integers(2, 6)):  # chairs, bins, boxes, wherever they were left
        at = [x0 + rng.uniform(0.6, size[0] - 0.6), y0 + rng.uniform(1.0, size[1] - 1.0)]
        half = rng.uniform(0.12, 0.35, 3)
        kind = CYLINDER if rng.random() < 0.4 else CUBE
        scene.add(kind, [*at, half[2]], half, Rotation.from_euler("z", rng.uniform(0, 6)))


def building(rng: np.random.Generator) -> tuple[Scene, list[np.ndarray]]:
    """Two corridors at a right angle with 16 offices along them, and 40 places to scan from.

    Each office is scanned from its middle and from the threshold of its open door, the corridors from between two doors
    and from where they meet.
    """
    scene, eyes = Scene(), []
    scene.add(CUBE, [0, 0, -0.1], [60, 60, 0.1])
    scene.add(CUBE, [0, 0, HEIGHT + 0.1], [60, 60, 0.1])
    for wing, count in ((0, 6), (1, 2)):
        length = count * ROOM
        turned = (lambda p: np.array(p, float)) if wing == 0 else (lambda p: np.array([-p[1], p[0]], float) + CORNER)
        doors = tuple(ROOM * (k + 0.5) for k in range(count))
        for side in (-1, 1):
            y = side * (CORRIDOR + WALL) / 2
            wall(scene, turned([0, y]), turned([length, y]), doors)
            wall(scene, turned([0, y + side * (DEPTH + WALL)]), turned([length, y + side * (DEPTH + WALL)]))
            for k in range(count + 1):
                ends = sorted([y + side * WALL / 2, y + side * (DEPTH + WALL / 2)])
                wall(scene, turned([k * ROOM, ends[0]]), turned([k * ROOM, ends[1]]))
            for k in range(count):
                low = turned([k * ROOM + WALL / 2, min(y, y + side * DEPTH) + WALL / 2])
                high = turned([(k + 1) * ROOM - WALL / 2, max(y, y + side * DEPTH) + WALL / 2])
                corner, size = np.minimum(low, high), np.abs(high - low)
                furnish(scene, rng, corner, size, side)
                middle = turned([(k + 0.5) * ROOM, y + side * DEPTH * 0.55]) + rng.normal(0, 0.3, 2)
                threshold = turned([(k + 0.5) * ROOM, y]) + rng.normal(0, 0.05, 2)
                eyes += [np.array([*p, 1.6 + rng.normal(0, 0.05)]) for p in (middle, threshold)]
        stands = [turned([d, 0]) for d in doors]
        if wing == 0:
            stands[2] = np.array([CORNER[0], 0.0])  # where the corridors meet, instead of between two doors
        eyes += [np.array([*(stand + rng.normal(0, 0.1, 2)), 1.6]) for stand in stands]
        for k in range(6 * count):  # what hangs and stands in a corridor, clear of the doors: cabinets, benches, boards
            side, along = rng.choice([-1, 1]), rng.uniform(0.05, 0.37) + 0.5 * (k % 2)
            half = rng.uniform([0.15, 0.08, 0.15], [0.5, 0.25, 0.8])
            at = turned([(k // 6 + 0.02 + along) * ROOM, side * (CORRIDOR / 2 - half[1])])
            low = half[2] if rng.random() < 0.6 else rng.uniform(half[2], HEIGHT - half[2])
            scene.add(CUBE, [*at, low], half if wing == 0 else half[[1, 0, 2]])
        wall(scene, turned([length, -CORRIDOR / 2]), turned([length, CORRIDOR / 2]))
    wall(scene, np.array([CORNER[0] - CORRIDOR / 2, -CORRIDOR / 2]), np.array([0, -CORRIDOR / 2]))
    wall(scene, np.array([CORNER[0] - CORRIDOR / 2, -CORRIDOR / 2]), np.array([CORNER[0] - CORRIDOR / 2, CORNER[1]]))
    wall(scene, np.array([CORNER[0] + CORRIDOR / 2, CORRIDOR / 2]), np.array([0, CORRIDOR / 2]))
    wall(scene, np.array([CORNER[0] + CORRIDOR / 2, CORRIDOR / 2]), np.array([CORNER[0] + CORRIDOR / 2, CORNER[1]]))
    return scene, eyes


CORNER = np.array(
    [-(DEPTH + CORRIDOR), DEPTH + CORRIDOR]
)  # where the second wing begins, clear of the first one's rooms


def terrestrial(scene: Scene, eye: np.ndarray, rng: np.random.Generator, columns: int = 480) -> np.ndarray:
    """World points of one scan, all round, 60 deg below the horizon to the zenith."""
    azimuth, elevation = np.meshgrid(
        np.linspace(0, 2 * np.pi, columns, False), np.radians(np.linspace(-60, 89, int(columns * 149 / 360)))
    )
    flat = np.cos(elevation)
    rays = np.stack([flat * np.cos(azimuth), flat * np.sin(azimuth), np.sin(elevation)], -1).reshape(-1, 3)
    points = scan(scene, eye, rays, rng, 0.0, 30.0)
    away = points - eye
    return points + away / np.linalg.norm(away, axis=1, keepdims=True) * rng.normal(0, NOISE, (len(away), 1))


def long_street(rng: np.random.Generator, pieces: int = 5, length: float = 160.0) -> list[Scene]:
    """Pieces of a street, each ``length`` along x, one behind the other."""
    scenes = []
    for k in range(pieces):
        piece = street(rng, length)
        for A in piece.maps:
            A[0, 3] += k * length
        scenes.append(piece)
    return scenes


def make(kind: str, out: Path, count: int | None, seed: int) -> None:
    """Scans to out/scans, T_world_scan of each to out/truth, unless they are there."""
    if (out / "truth").is_dir():
        return
    rng = np.random.default_rng(seed)
    for folder in ("scans", "truth.tmp"):
        (out / folder).mkdir(parents=True, exist_ok=True)
    if kind == "building":
        scene, eyes = building(rng)
        eyes = eyes[:count]
        views = (terrestrial(scene, eye, rng) for eye in eyes)
    else:
        scenes = long_street(rng)
        eyes = [np.array([x, rng.normal(0, 0.5), 1.8]) for x in np.linspace(-75, 5 * 160 - 85, 200)][:count]
        views = (street_view(scenes, eye, rng) for eye in eyes)
    for number, (points, eye) in enumerate(zip(views, eyes, strict=True)):
        T = np.eye(4)  # world to scan
        T[:3, :3] = Rotation.random(random_state=rng).as_matrix()
        T[:3, 3] = rng.uniform(-10, 10, 3) - T[:3, :3] @ eye
        name = f"scan_{rng.integers(10**6):06d}_{number}"
        write_cloud(out / "scans" / f"{name}.ply", PointCloud(points @ T[:3, :3].T + T[:3, 3]))
        np.savetxt(out / "truth.tmp" / f"{name}.txt", np.linalg.inv(T))
    (out / "truth.tmp").rename(out / "truth")


def street_view(scenes: list[Scene], eye: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """A revolution of a LiDAR of 32 beams; only pieces within reach are looked at."""
    near = Scene()
    for k, piece in enumerate(scenes):
        if abs(eye[0] - 160 * k) < 80 + 60:
            near.kinds += piece.kinds
            near.maps += piece.maps
    return scan(near, eye, lidar_rays(Rotation.identity(), 32, 720), rng, 0.0005, 60.0)


def run(out: Path, result: str, extra: list[str]) -> dict[str, float]:
    """`fmr multiway` on out/scans, as a process; what it cost."""
    folder = out / result
    command = [sys.executable, "-m", "fmr_cli.cli", "multiway", str(out / "scans"), "--out", str(folder), "-q", *extra]
    before, start = resource.getrusage(resource.RUSAGE_CHILDREN), time.perf_counter()
    done = subprocess.run(command, check=False)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    if done.returncode not in (0, 3):
        raise SystemExit(f"fmr multiway ended with {done.returncode}")
    cpu = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    return {"seconds": time.perf_counter() - start, "cpu s": cpu, "GiB": after.ru_maxrss / 2**20}


def best_frame(found: np.ndarray, true: np.ndarray) -> np.ndarray:
    """The rigid motion (4, 4) that brings places (n, 3) onto true ones."""
    a, b = found - found.mean(0), true - true.mean(0)
    U, _, Vt = np.linalg.svd(b.T @ a)
    T = np.eye(4)
    T[:3, :3] = U @ np.diag([1, 1, np.linalg.det(U @ Vt)]) @ Vt
    T[:3, 3] = true.mean(0) - T[:3, :3] @ found.mean(0)
    return T


def errors(poses: dict[str, np.ndarray], truth: dict[str, np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """Degrees and lengths (n,) of poses about the best common frame."""
    names = sorted(poses)
    G = best_frame(np.stack([poses[n][:3, 3] for n in names]), np.stack([truth[n][:3, 3] for n in names]))
    if len(names) < 4:  # too few places for a rotation: that of the first scan
        G = truth[names[0]] @ np.linalg.inv(poses[names[0]])
    off = [
        (angle_degrees(np.linalg.inv(truth[n]) @ G @ poses[n]), np.linalg.norm((G @ poses[n] - truth[n])[:3, 3]))
        for n in names
    ]
    return np.array(off).T[0], np.array(off).T[1]


def report(out: Path, result: str, cost: dict[str, float]) -> dict[str, object]:
    truth = {path.stem: np.loadtxt(path) for path in sorted((out / "truth").glob("*.txt"))}
    network = json.loads((out / result / "network.json").read_text())
    placed = [s for s in network["scans"] if s["component"] is not None]
    rows: dict[str, object] = {"scans": len(truth), "placed": len(placed), "components": len(network["components"])}
    for label, key in (("graph", "T_component_scan_graph"), ("refined", "T_component_scan")):
        rot, shift = [], []
        for number in range(len(network["components"])):
            poses = {s["name"]: np.array(s[key]) for s in placed if s["component"] == number}
            r, t = errors(poses, truth)
            rot, shift = [*rot, *r], [*shift, *t]
        rot, shift = np.array(rot), np.array(shift)
        if label == "refined":
            rows["placed wrongly"] = int(((rot > WRONG_DEGREES) | (shift > WRONG_SHIFT)).sum())
        rows[f"{label} shift median / max mm"] = f"{1e3 * np.median(shift):.2f} / {1e3 * shift.max():.2f}"
        rows[f"{label} rot median / max deg"] = f"{np.median(rot):.4f} / {rot.max():.4f}"
    sigma = np.array([s["sigma_shift"] for s in placed if s["sigma_shift"]])
    rows["sigma median mm"] = f"{1e3 * np.median(sigma):.2f}"
    links = network["links"]
    aligned = [x for x in links if x["status"] == "aligned"]
    right = 0
    for x in aligned:
        T = np.loadtxt(out / result / "links" / f"{x['source']}--{x['target']}.txt")
        true = np.linalg.inv(truth[x["target"]]) @ truth[x["source"]]
        right += (
            angle_degrees(np.linalg.inv(true) @ T) < WRONG_DEGREES and np.linalg.norm((T - true)[:3, 3]) < WRONG_SHIFT
        )
    rows |= {"looked at": network["counts"]["looked_at"], "registered": network["counts"]["registered"]}
    rows |= {"aligned": len(aligned), "right of them": right, "rejected": sum(x["status"] == "rejected" for x in links)}
    rows |= {name: round(value, 2) for name, value in cost.items()}
    rows["by stage"] = {name: round(value, 1) for name, value in network["seconds"].items()}
    return rows


@dataclass
class WrongLinks:
    """A network some of whose given links are wrong. wrong, rejected: by the scans' numbers, the higher one first.

    worst_shift: of a placed scan, about the best common frame, m.
    """

    network: Network
    wrong: set[tuple[int, int]]
    rejected: set[tuple[int, int]]
    worst_shift: float


def network_with_wrong_links(seed: int, scans: int = 40, links: int = 120, share: float = 0.1) -> WrongLinks:
    """Scans of one corner of a room with links that are given, 3 mm and 0.06 deg of noise; a share turned and moved.

    No pair is registered: the links alone have to tell which of them are wrong, small errors too (0.2 rad, 0.5 m).
    """
    rng = np.random.default_rng(seed)
    walls = rng.uniform(0, 3, (3, 4000, 3))
    for axis, wall_points in enumerate(walls):
        wall_points[:, axis] = 0.0
    walls = np.concatenate(walls)
    truth, clouds = [], []
    for _ in range(scans):
        T = np.eye(4)
        T[:3, :3], T[:3, 3] = Rotation.random(random_state=rng).as_matrix(), rng.uniform(-5, 5, 3)
        inverse = np.linalg.inv(T)
        truth.append(T)
        clouds.append(PointCloud(rng.choice(walls, 3000, replace=False) @ inverse[:3, :3].T + inverse[:3, 3]))
    pairs = [(i, j) for i in range(scans) for j in range(i)]
    ring = [(i, i - 1) for i in range(1, scans)] + [(scans - 1, 0)]
    others = [pair for pair in pairs if pair not in ring]
    chosen = ring + [others[k] for k in rng.choice(len(others), links - len(ring), replace=False)]
    wrong = {chosen[k] for k in rng.choice(links, round(share * links), replace=False)}
    known = []
    for i, j in pairs:
        turn, shift = rng.normal(0, 0.001, 3), rng.normal(0, 0.003, 3)
        if (i, j) in wrong:
            turn, shift = rng.normal(0, 0.2, 3), rng.normal(0, 0.5, 3)
        D = np.eye(4)
        D[:3, :3], D[:3, 3] = Rotation.from_rotvec(turn).as_matrix(), shift
        T = np.linalg.inv(truth[j]) @ D @ truth[i]
        use = "known" if (i, j) in chosen else "never"
        known.append(KnownLink(f"cloud_{i:03d}", f"cloud_{j:03d}", use, T if use == "known" else None))
    network = align_many(clouds, known=Known(links=known))
    rejected = {link.ends for link in network.links if link.status == "rejected"}
    poses = {f"{n:03d}": s.T_component_scan for n, s in enumerate(network.scans) if s.component == 0}
    shift = errors(poses, {f"{n:03d}": T for n, T in enumerate(truth)})[1]
    return WrongLinks(network, wrong, rejected, float(shift.max()))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("kind", choices=["building", "street", "wrong"])
    parser.add_argument("--out", type=Path, default=Path("/tmp/multiway"))
    parser.add_argument("--count", type=int, help="the first so many scans alone")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--extra", default="", help="further options of `fmr multiway`")
    args = parser.parse_args()
    if args.kind == "wrong":
        found = [network_with_wrong_links(args.seed + n) for n in range(10)]
        rows: dict[str, object] = {
            "networks, whole": f"{len(found)}, {sum(x.network.whole for x in found)}",
            "links made wrong": sum(len(x.wrong) for x in found),
            "of them rejected": sum(len(x.wrong & x.rejected) for x in found),
            "others rejected": sum(len(x.rejected - x.wrong) for x in found),
            "worst shift mm": round(1e3 * max(x.worst_shift for x in found), 2),
        }
    else:
        make(args.kind, args.out, args.count, args.seed)
        rows = report(args.out, "result", run(args.out, "result", args.extra.split()))
    for name, value in rows.items():
        print(f"{name:32s} {value}")


if __name__ == "__main__":
    main()
