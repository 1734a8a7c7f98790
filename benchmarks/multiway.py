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
from fmr_cli.synthetic.building import building, terrestrial
from fmr_cli.synthetic.scenes import Scene, lidar_rays, scan, street

WRONG_DEGREES, WRONG_SHIFT = 5.0, 0.1


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
