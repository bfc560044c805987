"""Two-view geometry and the graph of pairs that can be believed.

Inliers alone prove nothing: one tooth matched to its neighbour gives a perfect epipolar geometry.
What tells such pairs is that their matches don't move together locally (coherence) and that
rotations don't close around cycles.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.spatial import cKDTree

from pipeline.geometry.graph import Pair, spanning_pairs
from pipeline.geometry.models.colmap import quiet_pycolmap
from pipeline.geometry.rigid import angle_between
from stages.init.sfm.matching.epipolar import fundamental_of, sampson_distance

Array = npt.NDArray[np.float64]

#: Matches of a pair that take part in the random sampling.
MAX_SAMPLED_MATCHES = 800
#: Random samples at least. The confidence asks for more where the matches need them; COLMAP's own
#: least of 1000 takes four times as long and gave the same poses on all pairs of a scan video.
MIN_TRIALS = 100
#: So many other matches nearby have to move along with one that is believed.
TOGETHER = 2
#: A pair beside the spanning tree counts where its matches move together by more than this share,
#: and the rotation around the cycle that it closes is off by less than so many degrees.
CYCLE_COHERENCE, CYCLE_ANGLE = 0.5, 8.0


@dataclass(frozen=True)
class Lens:
    """What is known of a lens, shared by the views of one size and one known focal length.

    Attributes:
        width, height: pixels.
        focal: pixels, or None where nothing is known.
    """

    width: int
    height: int
    focal: float | None = None

    @property
    def long_side(self) -> int:
        return max(self.width, self.height)

    def camera(self, focal: float, distortion: float | None = None) -> Any:
        """The pycolmap camera with a focal length in pixels, its centre in the image's middle.

        A pinhole, or with a radial coefficient, 0 or not, COLMAP's SIMPLE_RADIAL.
        """
        pycolmap = quiet_pycolmap()
        if distortion is not None:
            return pycolmap.Camera(
                model="SIMPLE_RADIAL", width=self.width, height=self.height,
                params=[focal, self.width / 2, self.height / 2, distortion],
            )  # fmt: skip
        return pycolmap.Camera(
            model="SIMPLE_PINHOLE", width=self.width, height=self.height,
            params=[focal, self.width / 2, self.height / 2],
        )  # fmt: skip


@dataclass(frozen=True)
class Correspondences:
    """The matches of one pair of views, before any geometry.

    Attributes:
        features: [M, 2] int64 feature indices.
        positions_i, positions_j: [M, 2] float64 pixels.
        coherent: [M] bool, the match moves along with its neighbours.
        roll_i, roll_j: degrees by which the photographs are rolled clockwise; whether matches move
            together is asked with that taken out.
    """

    features: npt.NDArray[np.int64]
    positions_i: Array
    positions_j: Array
    coherent: npt.NDArray[np.bool_]
    roll_i: float = 0.0
    roll_j: float = 0.0

    def __len__(self) -> int:
        return len(self.features)


@dataclass(frozen=True)
class TwoView:
    """What two views say of each other under given focal lengths.

    Attributes:
        matches: how many matches went in.
        inliers: [I] int64 indices of the coherent matches that the essential matrix explains.
        coherence: share of coherent ones among all matches that it explains.
        j_from_i: [3, 4] float64 relative pose, translation of unit length.
    """

    matches: int
    inliers: npt.NDArray[np.int64]
    coherence: float
    j_from_i: Array

    @property
    def evidence(self) -> float:
        """How much the pair can be believed: coherent inliers times coherence squared.

        Of 215 pairs of dental frames 40 degrees and more apart, those more than 6 degrees wrong
        had at most 56, while right ones 35 degrees apart had from 73 on.
        """
        return len(self.inliers) * self.coherence**2

    @property
    def rotation(self) -> Array:
        """[3, 3] from the camera of i to that of j."""
        return self.j_from_i[:, :3]


def verify_pair(
    correspondences: Correspondences,
    camera_i: Any,
    camera_j: Any,
    *,
    max_error: float,
    coherence_radius: float,
    seed: int,
) -> TwoView | None:
    """Fit an essential matrix robustly to the coherent matches, then ask all matches about it.

    Args:
        camera_i, camera_j: pycolmap cameras.
        max_error: Sampson distance in pixels up to which a match is an inlier.
        coherence_radius: pixels in which the neighbours of a match are looked for.
        seed: of the random samples.

    Returns:
        None if no geometry was found at all.
    """
    pycolmap = quiet_pycolmap()
    # Matches come most similar first; more than this many only cost time.
    seeds = np.flatnonzero(correspondences.coherent)[:MAX_SAMPLED_MATCHES]
    if len(seeds) < 8:
        return None
    options = pycolmap.RANSACOptions()
    options.max_error = max_error
    options.confidence = 0.9999
    options.max_num_trials = 1000
    options.min_num_trials = MIN_TRIALS
    options.random_seed = seed
    options.num_threads = 1
    found = pycolmap.estimate_essential_matrix(
        correspondences.positions_i[seeds],
        correspondences.positions_j[seeds],
        camera_i,
        camera_j,
        options,
    )
    if found is None:
        return None
    fundamental = fundamental_of(
        np.asarray(found["E"]),
        np.asarray(camera_i.calibration_matrix()),
        np.asarray(camera_j.calibration_matrix()),
    )
    errors = sampson_distance(fundamental, correspondences.positions_i, correspondences.positions_j)
    inliers = np.flatnonzero(errors <= max_error)
    # Asked again among the inliers: what gave a false match its support may be gone.
    coherent = coherent_matches(
        unrolled(correspondences.positions_i[inliers], correspondences.roll_i),
        unrolled(correspondences.positions_j[inliers], correspondences.roll_j),
        coherence_radius,
    )
    return TwoView(
        matches=len(correspondences),
        inliers=inliers[coherent],
        coherence=float(coherent.mean()) if len(inliers) else 0.0,
        j_from_i=np.asarray(found["cam2_from_cam1"].matrix(), np.float64),
    )


def homography_share(
    correspondences: Correspondences, inliers: npt.NDArray[np.int64], max_error: float, seed: int
) -> float:
    """Share of a pair's inliers that one homography explains within `max_error` pixels.

    All of them: the camera only turned, or what it saw is flat; either way there is no depth.
    """
    pycolmap = quiet_pycolmap()
    if len(inliers) < 8:
        return 0.0
    options = pycolmap.RANSACOptions()
    options.max_error = max_error
    options.max_num_trials = 1000
    options.min_num_trials = MIN_TRIALS
    options.random_seed = seed
    options.num_threads = 1
    sampled = inliers[:MAX_SAMPLED_MATCHES]
    found = pycolmap.estimate_homography_matrix(
        correspondences.positions_i[sampled], correspondences.positions_j[sampled], options
    )
    return 0.0 if found is None else float(np.mean(np.asarray(found["inlier_mask"], bool)))


def coherent_matches(
    positions_i: Array, positions_j: Array, radius: float
) -> npt.NDArray[np.bool_]:
    """Tell the matches [M, 2] that at least `TOGETHER` others within `radius` move along with.

    Two matches move together if their displacements differ by less than radius / 8 plus .35 of
    their distance: what a surface that turns by up to about 30 degrees does.
    """
    support = np.zeros(len(positions_i), np.int64)
    if len(positions_i) < 2:
        return support >= TOGETHER
    near = cKDTree(positions_i).query_pairs(radius, output_type="ndarray")
    apart = np.linalg.norm(positions_i[near[:, 0]] - positions_i[near[:, 1]], axis=1)
    moved = positions_j - positions_i
    differ = np.linalg.norm(moved[near[:, 0]] - moved[near[:, 1]], axis=1)
    # Matches on the same spot say nothing about each other.
    together = near[(apart > radius / 20) & (differ < radius / 8 + 0.35 * apart)]
    np.add.at(support, together.ravel(), 1)
    return support >= TOGETHER


def unrolled(positions: Array, degrees: float) -> Array:
    """Pixels [M, 2] turned back about the image's corner by a clockwise roll."""
    if not degrees:
        return positions
    cosine, sine = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    return np.asarray(positions @ np.array([[cosine, -sine], [sine, cosine]]))


def rotations_along(tree: list[Pair], edges: dict[Pair, TwoView], root: int) -> dict[int, Array]:
    """[3, 3] rotations relative to the view `root`, of the views that the tree connects to it."""
    rotations = {root: np.eye(3)}
    grown = True
    while grown:
        grown = False
        for i, j in tree:
            if i in rotations and j not in rotations:
                rotations[j] = edges[i, j].rotation @ rotations[i]
                grown = True
            elif j in rotations and i not in rotations:
                rotations[i] = edges[i, j].rotation.T @ rotations[j]
                grown = True
    return rotations


def trusted_edges(
    edges: dict[Pair, TwoView],
    view_count: int,
    *,
    min_evidence: float = 65.0,
    min_inliers: int = 25,
) -> list[Pair]:
    """Choose the pairs to reconstruct from, sorted.

    A maximum spanning forest of pairs with enough evidence; any other pair only if the rotation
    around the cycle that it closes is right within `CYCLE_ANGLE` degrees.
    """
    enough = {pair: edge for pair, edge in edges.items() if len(edge.inliers) >= min_inliers}
    believed = {
        pair: edge.evidence for pair, edge in enough.items() if edge.evidence >= min_evidence
    }
    tree = spanning_pairs(believed)
    kept = set(tree)
    placed: set[int] = set()
    for view in range(view_count):
        if view in placed:
            continue
        rotations = rotations_along(tree, edges, view)
        placed.update(rotations)
        for (i, j), edge in enough.items():
            if (i, j) in kept or i not in rotations or j not in rotations:
                continue
            error = angle_between(edge.rotation @ rotations[i], rotations[j])
            if error < CYCLE_ANGLE and edge.coherence > CYCLE_COHERENCE:
                kept.add((i, j))
    return sorted(kept)
