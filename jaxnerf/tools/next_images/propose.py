"""Where further images of a trained run's scene should be taken, in words and as a camera path."""

import os
import pathlib
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from jaxnerf.core import contraction
from jaxnerf.core.occupancy.grid import OccupancyGrid
from jaxnerf.core.types import Camera
from jaxnerf.core.views import Views
from jaxnerf.data.geometry.poses import gaze_center, up_of
from jaxnerf.data.geometry.world import unit_of
from jaxnerf.evaluation.paths import camera_path
from jaxnerf.evaluation.paths.camera_path import CameraPath
from jaxnerf.evaluation.restore import newest_step, refined_views, restore_run
from jaxnerf.runtime import stages
from jaxnerf.tools.next_images import path_files
from jaxnerf.tools.next_images.candidate_poses import Candidates, azimuth_to_right, candidate_poses, farthest_poses
from jaxnerf.tools.next_images.coverage import ViewCoverage, choose_views

NAME = "next_images"  # of the camera path
_THIN = 15.0  # degrees by which what is thinly covered has been seen from farther aside than the images themselves
_MOST_THIN = 5  # groups that are named
_MOST_CELLS = 6000  # that are plotted
_FAR_IN_NDC = 0.8  # ten times as far away as the near plane, where 1 is at infinity
_FOGGY = 20.0  # degrees of the images themselves, above which only differences from them say something
_UNITS = "units of the dataset's files"
_ZENITH = 85.0  # degrees, above which an azimuth says nothing


class Proposal(NamedTuple):
    """A further image.

    Attributes:
        pose: [3, 4] in the run's world.
        words: where to take it, from the nearest image.
        angle: degrees, from how far aside what it shows has been seen, by the images and the proposals before it.
    """

    pose: Float[np.ndarray, "3 4"]
    words: str
    angle: float


class CoverageReport(NamedTuple):
    """What `propose_images` finds.

    Attributes:
        step: of the checkpoint.
        views: of the split "train", with refined cameras.
        up: unit vector.
        candidates: those that were compared.
        own_angle: the median over the images of the same for their own views: what rounding and thin fog leave.
        angles: [rows, columns] of the candidates' groups, degrees: from how far aside what a camera there would show
            has been seen; NaN where there is no candidate.
        positions: [M, 3] of cells that have been seen, world units, at most a few thousand; in NDC, of the near ones.
        directions: [M] from how many of the 64 directions.
        counts: [65] how many occupied cells have been seen from so many directions.
        proposals: the best first.
        path: of the proposals.
    """

    step: int
    views: Views
    up: Float[np.ndarray, "3"]
    candidates: Candidates
    own_angle: float
    angles: Float[np.ndarray, "R C"]
    positions: Float[np.ndarray, "M 3"]
    directions: Int[np.ndarray, " M"]
    counts: Int[np.ndarray, "65"]
    proposals: tuple[Proposal, ...]
    path: CameraPath

    @property
    def next_cameras(self) -> Camera:
        """The cameras of the proposals, stacked, with the lens of the first view."""
        path = self.path
        return Camera(to_world=path.poses, focal=path.focal, center=path.center, height=path.height, width=path.width)

    def text(self) -> str:
        """Returns the report as text."""
        seen = self.counts[1:].sum()
        few = self.counts[1:4].sum() / max(seen, 1)
        lines = [
            f"images   {len(self.views.names)} of the split train, with the checkpoint of step {self.step}",
            f"cells    {self.counts.sum():,} occupied, {seen:,} seen; {few:.0%} of these from 1 to 3 of 64 directions",
            f"cameras  {self.candidates.kind}, as {self.candidates.reason}",
            "",
            "From how far aside what a camera would show has been seen, in degrees" + self._beyond,
            f"by where it would be ({_PLACES[self.candidates.kind].format(first=_name(self.views, 0))}).",
            f"{self._own}:",
            *_table(self.angles - self._base, self.candidates),
            "",
            *self._thin(),
            "",
            "Next images, each as if those before it had been taken:",
        ]
        for number, each in enumerate(self.proposals, 1):
            seen = f"seen from {max(each.angle - self._base, 0):.0f} degrees{' farther' if self._base else ''} aside"
            seen += " than the images themselves" if self._base else ""
            seen = "nothing of it has been seen" if each.angle > 179 else seen
            lines.append(f"{number:3}. {each.words}; {seen}")
        return "\n".join(lines)

    @property
    def _base(self):
        """The angle that counts as none: where light passes the scene, or fog is, the images' own says nothing."""
        return self.own_angle if self.own_angle > _FOGGY else 0.0

    @property
    def _beyond(self):
        return " beyond what the images themselves have" if self._base else ""

    @property
    def _own(self):
        if self._base:
            return "Light that passes the scene and fog count as unseen, so only differences say something"
        return f"The images themselves have {self.own_angle:.0f} degrees, by rounded directions and by fog"

    def _thin(self):
        most = self.own_angle + _THIN
        rows, columns = np.nonzero(np.nan_to_num(self.angles) > most)
        if not len(rows):
            limit = f"{most - self._base:.0f} degrees{self._beyond or ' aside'}"
            return [f"thin     nowhere: everything has been seen from at most {limit}"]
        order = np.argsort(-self.angles[rows, columns])[:_MOST_THIN]
        names = [
            f"{self.candidates.rows[row]}, {self.candidates.columns[column]} "
            f"({self.angles[row, column] - self._base:.0f} degrees)"
            for row, column in zip(rows[order], columns[order], strict=True)
        ]
        more = f"; and {len(rows) - len(order)} more" if len(rows) > len(order) else ""
        return [f"thin     {'; '.join(names)}{more}"]


_PLACES = {
    "around": "columns: azimuth around the scene, degrees to the right of {first}",
    "beside": "in the plane of the cameras",
    "turned": "columns: azimuth of the gaze, degrees to the right of that of {first}",
}


def propose_images(
    workdir: str | os.PathLike,
    count: int = 5,
    *,
    step: int | None = None,
    data_dir: str | None = None,
    up: str | None = None,
) -> CoverageReport:
    """Finds how well the images of a trained run cover its scene, and where further ones should be taken.

    Args:
        workdir: the folder that training wrote.
        count: number of further images.
        step: of the checkpoint; the newest when None.
        data_dir: the dataset's folder in place of the config's.
        up: the axis of the dataset's files that is up, such as "+z"; None: the run's option `data.up`, or as the
            cameras are held.

    Raises:
        ValueError: if there is no such run or checkpoint, the scene moves, its grid has no occupied cell, or there are
            fewer than two different cameras.
    """
    run = restore_run(workdir, data_dir=data_dir, settings={"bake_occupancy": True})
    step = newest_step(run, workdir, step)
    variables = run.variables(step)
    views = refined_views(run, run.experiment.load_split("train", images=False), "train", variables[0])
    if views.time is not None:
        raise ValueError(
            f"{workdir}: the scene moves, so that each image shows another instant, expected one that stays as it is; "
            "coverage is not known here"
        )
    if not np.asarray(variables[1].occupied).any():
        raise ValueError(f"{workdir}: no cell of its occupancy grid is occupied, expected a scene; train it for longer")
    poses = np.asarray(views.cameras.to_world, np.float64)
    direction = camera_path.up_direction(up or run.experiment.config.data.up or None, views)
    direction = up_of(poses) if direction is None else direction
    coverage, found = ViewCoverage(run, variables), candidate_poses(poses, direction)
    if found.kind == "around":
        found = _accessible(found, coverage, poses, workdir)
    with stages.stage("finding what the cameras see, by images") as stage:
        for index in range(len(poses)):
            stage.update(index, len(poses))
            coverage.add(views, index)
    posed = camera_path.posed_views(views, camera_path.through_first_lens(NAME, found.poses, views))
    with stages.stage("comparing places for further images"):
        own_angle = float(np.median([coverage.score(views, index).angle for index in range(len(poses))]))
        scores = {index: coverage.score(posed, index) for index in range(len(found.poses))}
        positions, directions = _shown_cells(variables[1], coverage, views, run.experiment.config.data.ndc)
        counts = np.bincount(coverage.num_directions().ravel() + 1, minlength=66)[1:]
        chosen = choose_views(coverage, posed, scores, count, least_angle=own_angle + _THIN)
        # Where all is well seen, the least familiar views are those that show most fog, which are neighbours.
        taken = [index for index, _ in chosen]
        rest = np.setdiff1d(np.arange(len(found.poses)), taken)
        seen_from = np.concatenate([poses, found.poses[taken]])
        for index in map(int, rest[farthest_poses(seen_from, found.poses[rest], count - len(chosen))]):
            chosen.append((index, coverage.score(posed, index)))
            coverage.add(posed, index)
    proposals = [
        Proposal(found.poses[index], _words(found, index, views, direction), score.angle) for index, score in chosen
    ]
    return CoverageReport(
        step=step,
        views=views,
        up=direction,
        candidates=found,
        own_angle=own_angle,
        angles=_angles(scores, found),
        positions=positions,
        directions=directions,
        counts=counts,
        proposals=tuple(proposals),
        path=camera_path.through_first_lens(NAME, np.stack([each.pose for each in proposals]), views),
    )


def save_path(report: CoverageReport, workdir: str | os.PathLike) -> pathlib.Path:
    """Writes the proposals to <workdir>/camera_paths/next_images.json, which jaxnerf-render and the viewer show."""
    file = path_files.file_of(workdir, NAME)
    file.parent.mkdir(exist_ok=True)
    path_files.write_path_file(file, report.path, report.views)
    return file


def _accessible(candidates, coverage, poses, workdir):
    """Returns the Candidates to which a straight line from the nearest camera passes no matter."""
    free = coverage.is_free(poses[candidates.nearest, :, 3], candidates.poses[:, :, 3])
    if not free.any():
        raise ValueError(
            f"{workdir}: no straight line from a camera to a place around the scene is free of matter, expected free "
            "space between the cameras; train it for longer"
        )
    return candidates._replace(**{name: getattr(candidates, name)[free] for name in ("poses", "nearest", "group")})


def _angles(scores, candidates):
    """Returns the mean angle [rows, columns] of the views of each group; NaN where there is none."""
    shape = len(candidates.rows), len(candidates.columns)
    total, number = np.zeros(shape), np.zeros(shape)
    for index, group in enumerate(candidates.group):
        total[tuple(group)] += scores[index].angle
        number[tuple(group)] += 1
    return np.where(number > 0, total / np.maximum(number, 1), np.nan)


def _shown_cells(grid: OccupancyGrid, coverage, views, ndc):
    """Returns the positions of cells that have been seen, and from how many directions; see `CoverageReport`."""
    counts = coverage.num_directions()
    places = np.argwhere(counts > 0)
    if not len(places):
        return np.zeros((0, 3)), np.zeros(0, int)
    places = places[:: -(-len(places) // _MOST_CELLS)]
    fractions = (places + 0.5) / counts.shape
    if grid.contracted:
        fractions = (np.asarray(contraction.expand(np.float32(4 * fractions - 2))) + 2) / 4
    lower, upper = np.float64(grid.lower), np.float64(grid.upper)
    positions, counts = lower + fractions * (upper - lower), counts[tuple(places.T)]
    if not ndc:
        return positions, counts
    near = positions[:, 2] < _FAR_IN_NDC
    positions, counts = positions[near], counts[near]
    depth = 2 / (1 - positions[:, 2:])  # Eq. 25 of arXiv:2003.08934 with n = 1, solved for the position
    slopes = positions[:, :2] * views.size[0, ::-1] / (2 * np.float64(views.cameras.focal[0]))
    return np.concatenate([slopes * depth, -depth], axis=1), counts


def _table(angles, candidates):
    """Returns the lines of a table of the rows that have candidates."""
    name = max(map(len, candidates.rows))
    lines = [" " * name + "".join(f"{column:>8}" for column in candidates.columns)]
    for row, found in zip(candidates.rows, angles, strict=True):
        if np.isfinite(found).any():
            cells = "".join(f"{angle:8.0f}" if np.isfinite(angle) else f"{'-':>8}" for angle in found)
            lines.append(f"{row:{name}}{cells}")
    return lines


def _words(candidates, index, views, up):
    """Returns where a candidate is, from the nearest image."""
    near, pose = int(candidates.nearest[index]), candidates.poses[index]
    poses = np.asarray(views.cameras.to_world, np.float64)
    unit = 1.0 if views.to_file is None else unit_of(views.to_file)
    name, old = _name(views, near), poses[near]
    if candidates.kind == "around":
        center = gaze_center(poses)
        offset, before = pose[:, 3] - center, old[:, 3] - center
        right = float(np.degrees(azimuth_to_right(offset[None], before, up)[0]))
        height, old_height = (_height(each, up) for each in (offset, before))
        moves = [_part(right, "to the right around the scene", "to the left around the scene")]
        moves = [] if height > _ZENITH else moves
        moves.append(_part(height - old_height, "up", "down"))
        moves = [move for move in moves if move] or ["a little aside"]
        distance = unit * np.linalg.norm(offset)
        place = f"{abs(height):.0f} degrees {'high' if height >= 0 else 'below the horizon'}"
        return f"from {name} {' and '.join(moves)}: {place}, at a distance of {distance:.3g} {_UNITS}"
    if candidates.kind == "beside":
        x, y = unit * (pose[:, 3] - old[:, 3]) @ old[:, :2]
        side, way = "right" if x > 0 else "left", "up" if y > 0 else "down"
        return f"from {name} {abs(x):.3g} {_UNITS} to the {side} and {abs(y):.3g} {way}"
    right = float(np.degrees(-azimuth_to_right(-pose[None, :, 2], -old[:, 2], up)[0]))
    pitch = _height(-pose[:, 2], up)
    level = "level" if abs(pitch) < 1 else f"{abs(pitch):.0f} degrees {'up' if pitch > 0 else 'down'}"
    turn = _part(right, "to the right", "to the left") or "0 degrees"
    return f"at the place of {name}, turned {turn}, looking {level}"


def _height(offset, up):
    """Returns the angle of an offset above the plane perpendicular to up, degrees."""
    return float(np.degrees(np.arcsin(np.clip(offset @ up / np.linalg.norm(offset), -1, 1))))


def _part(angle, positive, negative):
    """Returns an angle in words; "" if it is less than a degree."""
    return f"{abs(angle):.0f} degrees {positive if angle > 0 else negative}" if abs(angle) >= 1 else ""


def _name(views, index):
    return f"'{views.names[index]}'" if views.names else f"view {index}"
