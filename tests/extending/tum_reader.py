"""An example of a dataset reader: image files and a trajectory, after the text format of the TUM RGB-D benchmark.

    camera.txt        focal_x focal_y center_x center_y    (px)
    trajectory.txt    one line per image: file x y z qx qy qz qw

Positions are in world units; a unit quaternion rotates from the camera's axes (x right, y down, z forward) to the
world's. Lines that begin with # are comments. Train on such a folder by

    jaxnerf-train --plugins=tum_reader --config=capture --data_dir=FOLDER --workdir=runs/tum
"""

import numpy as np
from scipy.spatial.transform import Rotation

import jaxnerf
from jaxnerf.extend import Capture, Frame

DOWN_FORWARD_TO_UP_BACKWARD = [1, -1, -1]  # jaxnerf's cameras have x right, y up, and look along -z


def is_tum(folder):
    """Returns whether a folder holds this format; used where the config's data.format is "auto"."""
    return (folder / "trajectory.txt").exists() and (folder / "camera.txt").exists()


def read_tum(folder):
    """Reads the cameras and the names of the images; jaxnerf decodes the images and finds near and far."""
    focal_x, focal_y, center_x, center_y = np.loadtxt(folder / "camera.txt")
    frames = []
    for number, line in enumerate((folder / "trajectory.txt").read_text().splitlines(), start=1):
        if not line.strip() or line.startswith("#"):
            continue
        name, *numbers = line.split()
        if len(numbers) != 7:
            raise ValueError(
                f"{folder / 'trajectory.txt'}: line {number} has {len(numbers)} numbers, expected 7 after the file"
            )
        position, quaternion = np.split(np.array(numbers, float), [3])
        rotation = Rotation.from_quat(quaternion).as_matrix() * DOWN_FORWARD_TO_UP_BACKWARD
        camera = jaxnerf.Camera(
            to_world=np.column_stack([rotation, position]),
            focal=np.array([focal_x, focal_y]),
            center=np.array([center_x, center_y]),
        )
        frames.append(Frame(name=name.rsplit(".", 1)[0], image=folder / name, camera=camera))
    frames.sort(key=lambda frame: frame.name)
    return Capture(format="tum", source=folder / "trajectory.txt", frames=tuple(frames))


jaxnerf.register_reader("tum", read_tum, detect=is_tum)
