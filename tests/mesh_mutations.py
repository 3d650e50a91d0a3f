"""Damaged mesh files, each from a seed, and a look at what is read from them.

    container/run python3 tests/mesh_mutations.py --count 5000 --seed 0

prints how many were read and refused, and the seeds of those that were not one or the other.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from collections import Counter
from pathlib import Path

import numpy as np
from helpers import MESHES

from signorini_cr.errors import InputError
from signorini_cr.mesh.domain import PARTS, USUAL
from signorini_cr.mesh.gmshmesh import Triangulation, read

NUMBERS = (
    "0 -1 1 2 3 7 48 49 50 nan inf -inf 1e308 1e99 1e30 -5 0.5 1e-300 2147483648 "
    "9223372036854775807 99999999999999999999 1_0 0x10 +4 1e3 -0 abc 1e 4.1 15 92"
).split()


def sources(folder: Path) -> list[bytes]:
    """The ready meshes, in both formats, ASCII and binary."""
    import gmsh

    found = [(MESHES / name).read_bytes() for name in ("signorini.msh", "signorini-2.2.msh")]
    gmsh.initialize(argv=[], readConfigFiles=False, interruptible=False)
    try:
        gmsh.option.setNumber("General.Terminal", 0)
        gmsh.option.setNumber("Mesh.Binary", 1)
        gmsh.merge(str(MESHES / "signorini.msh"))
        for version in (4.1, 2.2):
            gmsh.option.setNumber("Mesh.MshFileVersion", version)
            path = folder / f"binary-{version}.msh"
            gmsh.write(str(path))
            found.append(path.read_bytes())
    finally:
        gmsh.finalize()
    return found


MOVED = 1_000_000
"""From this seed on files stay well-formed."""


def mutated(texts: list[bytes], seed: int) -> bytes:
    """One of the files, damaged."""
    random = np.random.default_rng(seed)
    if seed >= MOVED:
        data = texts[int(random.integers(2))]
        for _ in range(int(random.integers(1, 5))):
            data = _meaning(data, random)
        return data
    which = int(random.integers(len(texts)))
    data = texts[which]
    for i in range(int(random.choice([1, 1, 1, 2, 4]))):
        kinds = ["bytes", "lines", "numbers", "meaning"][
            : 4 if i == 0 else 3
        ]  # it needs them whole
        kind = random.choice(kinds) if which < 2 else "bytes"
        data = _MUTATIONS[str(kind)](data, random) or b"$"
    return data


def _bytes(data: bytes, random: np.random.Generator) -> bytes:
    a, b = sorted(random.integers(len(data) + 1, size=2))
    near = min(len(data), a + int(random.integers(1, 20)))
    found = bytearray(data)
    match random.integers(6):
        case 0 | 1:
            for at in random.integers(len(data), size=random.integers(1, 6)):
                found[at] ^= 1 << int(random.integers(8))
        case 2:
            found[a:near] = random.integers(256, size=near - a, dtype=np.uint8).tobytes()
        case 3:
            del found[a : near if random.random() < 0.7 else b]
        case 4:
            found[a:a] = found[a : near if random.random() < 0.7 else b]
        case 5:
            del found[a:]
    return bytes(found)


def _lines(data: bytes, random: np.random.Generator) -> bytes:
    lines = data.split(b"\n")
    at, other = random.integers(len(lines), size=2)
    cut = int(random.integers(len(lines[at]) + 1))
    match random.integers(5):
        case 0:
            lines[at : at + 1] = [lines[at][:cut], lines[at][cut:]]
        case 1:
            del lines[at]
        case 2:
            lines.insert(at, lines[at])
        case 3:
            lines[at], lines[other] = lines[other], lines[at]
        case 4:
            lines[at : at + 2] = [b" ".join(lines[at : at + 2])]
    return b"\n".join(lines)


def _numbers(data: bytes, random: np.random.Generator) -> bytes:
    lines = [line.split(b" ") for line in data.split(b"\n")]
    line = lines[int(random.integers(len(lines)))]
    line[int(random.integers(len(line)))] = str(random.choice(NUMBERS)).encode()
    return b"\n".join(b" ".join(words) for words in lines)


def _meaning(data: bytes, random: np.random.Generator) -> bytes:
    """Well-formed, but another mesh: nodes moved, corners exchanged, elements away or twice."""
    lines = data.split(b"\n")
    nodes = [i for i, line in enumerate(lines) if len(line.split()) >= 3 and b"." in line]
    rows = [i for i, line in enumerate(lines) if len(line.split()) in (4, 7, 8) and i > nodes[-1]]
    at, row = int(random.choice(nodes)), int(random.choice(rows or nodes))
    words = lines[at].split()
    match random.integers(5):
        case 0 | 1:
            place = int(random.integers(len(words) - 3, len(words) - 1))
            size = 10.0 ** random.uniform(-3, 3)
            words[place] = repr(float(random.normal()) * size).encode()
            lines[at] = b" ".join(words)
        case 2:
            words = lines[row].split()
            words[-1], words[-2] = words[-2], words[-1]
            lines[row] = b" ".join(words)
        case 3:
            words = lines[row].split()
            words[-1] = str(random.integers(1, 50)).encode()
            lines[row] = b" ".join(words)
        case 4:
            change = int(random.choice([-1, 1]))
            lines[row : row + 1] = [lines[row]] * (1 + change)
            head = next(i for i, line in enumerate(lines) if line == b"$Elements") + 1
            counts = lines[head].split()
            place = 0 if len(counts) == 1 else 1
            counts[place] = str(int(counts[place]) + change).encode() if counts else b""
            lines[head] = b" ".join(counts)
            if len(counts) > 1:
                block = max(
                    i
                    for i, line in enumerate(lines[: row + 1])
                    if len(line.split()) == 4 and line.split()[0] in (b"0", b"1", b"2")
                )
                words = lines[block].split()
                words[3] = str(int(words[3]) + change).encode()
                lines[block] = b" ".join(words)
    return b"\n".join(lines)


_MUTATIONS = {"bytes": _bytes, "lines": _lines, "numbers": _numbers, "meaning": _meaning}


def faults(raw: Triangulation) -> list[str]:
    """Find what is wrong with a mesh, by brute force."""
    found = []
    x, t = raw.points, raw.triangles
    if not np.isfinite(x).all():
        return ["not finite"]
    if not np.array_equal(np.unique(t), np.arange(len(x))):
        found.append("a node of no triangle")
    p = x[t]
    u, v = p[:, 1] - p[:, 0], p[:, 2] - p[:, 0]
    det = u[:, 0] * v[:, 1] - u[:, 1] * v[:, 0]
    if not (np.abs(det) > 0).all():
        return [*found, "no area"]
    centres = p.mean(axis=1)
    for what, points, own in (
        ("a node inside a triangle or a side", x, [set(np.flatnonzero((t == i).any(axis=1)))
                                                   for i in range(len(x))]),
        ("triangles overlap", centres, [{i} for i in range(len(t))]),
    ):  # fmt: skip
        w = points[:, None] - p[None, :, 0]
        b = (w[..., 0] * v[:, 1] - w[..., 1] * v[:, 0]) / det
        c = (u[:, 0] * w[..., 1] - u[:, 1] * w[..., 0]) / det
        least = np.minimum(np.minimum(b, c), 1 - b - c)
        most = np.maximum(np.maximum(b, c), 1 - b - c)
        inside = (least > -1e-13) & (most < 1 - 1e-9)
        for i, j in zip(*np.nonzero(inside), strict=True):
            if j not in own[i]:
                found.append(f"{what}: {points[i]}")
                break
    sides = np.sort(t[:, [[1, 2], [0, 2], [0, 1]]].reshape(-1, 2), axis=1)
    edges, count = np.unique(sides, axis=0, return_counts=True)
    if count.max() > 2:
        found.append("three triangles at a side")
    a, b = x[edges[:, 0]], x[edges[:, 1]]

    def turn(i, j, k):
        d, e = j - i, k - i
        left, right = d[..., 0] * e[..., 1], d[..., 1] * e[..., 0]
        return np.sign(left - right) * (np.abs(left - right) > 1e-11 * (abs(left) + abs(right)))

    A, B, C, D = a[:, None], b[:, None], a[None], b[None]
    if np.any((turn(A, B, C) * turn(A, B, D) < 0) & (turn(C, D, A) * turn(C, D, B) < 0)):
        found.append("sides cross")
    rim = {tuple(edge) for edge in edges[count == 1].tolist()}
    if not {tuple(sorted(facet)) for facet in raw.facets.tolist()} <= rim:
        found.append("a label that is not on the boundary")
    if not {1, 2} <= set(raw.labels.tolist()):
        found.append("no contact or no Dirichlet part")
    return found


def outcome(path: Path, data: bytes) -> tuple[str, str]:
    """Read such a file: the result is read, refused, or wrong; and the words."""
    path.write_bytes(data)
    began = time.perf_counter()
    try:
        raw = read(path, PARTS, USUAL)
    except InputError as error:
        words = str(error)
        good = words.startswith(f"{path}: ") and "\n" not in words and len(words) < 600
        return ("refused" if good else "wrong"), words
    except Exception as error:
        return "wrong", f"{type(error).__name__}: {error}"
    if time.perf_counter() - began > 5:
        return "wrong", "it took more than 5 seconds"
    found = faults(raw)
    return ("wrong" if found else "read"), "; ".join(found)


def main() -> None:
    """Count the outcomes and show those that are wrong."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--count", type=int, default=500)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--words", action="store_true", help="print each kind of message once")
    arguments = parser.parse_args()
    counts: Counter[str] = Counter()
    with tempfile.TemporaryDirectory() as folder:
        texts = sources(Path(folder))
        path = Path(folder) / "mesh.msh"
        for seed in range(arguments.seed, arguments.seed + arguments.count):
            result, words = outcome(path, mutated(texts, seed))
            counts[result] += 1
            if result == "wrong":
                print(f"seed {seed}: {words}", flush=True)
            elif arguments.words:
                print(f"{result} {seed} {words.removeprefix(str(path))}", flush=True)
    print(", ".join(f"{count} {result}" for result, count in sorted(counts.items())))


if __name__ == "__main__":
    main()
