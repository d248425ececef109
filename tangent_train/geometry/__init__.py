"""Pure geometry of panoramas and tangent images; NumPy only, float64.

Convention, stated here once and used everywhere:

* **Directions** are unit vectors ``x = cos φ cos λ, y = cos φ sin λ, z = sin φ`` with latitude φ
  growing upwards and longitude λ growing to the right, as seen from the center: x points to the
  middle of the panorama, y to the right, z up. This frame is left-handed. Files have the
  right-handed frame with y to the left; `to_right_handed` converts between the two.
* **Equirectangular (ERP) pixels** have integer centers ``(u, v)``, u to the right, v down:
  ``λ = (u + ½) / W · 2π − π``, ``φ = π/2 − (v + ½) / H · π``. Longitude wraps for every
  interpolation, nearest included; beyond a pole the row reflects with a half-turn in longitude.
* **Camera axes** are x right, y down, z forward. **Image pixels** have integer centers, so that a
  camera matrix maps the pixel in row i, column j to (j, i).
* Angles are in radians unless a name ends in ``deg``.
"""

from tangent_train.geometry.camera import (
    camera_matrix_from_fov,
    is_camera_matrix,
    lengths_of_rays,
    perspective_directions,
    ray_lengths,
    shift_range,
)
from tangent_train.geometry.cube import CubeGrid
from tangent_train.geometry.equirect import (
    equirect_directions,
    equirect_elevations,
    equirect_latitudes,
    equirect_longitudes,
    equirect_shape,
    equirect_solid_angles,
    equirect_to_lonlat,
    lonlat_to_equirect,
    nearest_level,
)
from tangent_train.geometry.grid import TangentGrid
from tangent_train.geometry.horizontal import RingGrid
from tangent_train.geometry.icosphere import Icosphere, icosphere, vertex_resolution
from tangent_train.geometry.panorama_pose import PanoramaPose
from tangent_train.geometry.pinhole_grid import PinholeGrid
from tangent_train.geometry.sphere import (
    checked_rotation,
    lonlat_to_xyz,
    random_rotation,
    rotation_about,
    to_right_handed,
    xyz_to_lonlat,
)

__all__ = [
    "CubeGrid",
    "Icosphere",
    "PanoramaPose",
    "PinholeGrid",
    "RingGrid",
    "TangentGrid",
    "camera_matrix_from_fov",
    "checked_rotation",
    "equirect_directions",
    "equirect_elevations",
    "equirect_latitudes",
    "equirect_longitudes",
    "equirect_shape",
    "equirect_solid_angles",
    "equirect_to_lonlat",
    "icosphere",
    "is_camera_matrix",
    "lengths_of_rays",
    "lonlat_to_equirect",
    "lonlat_to_xyz",
    "nearest_level",
    "perspective_directions",
    "random_rotation",
    "ray_lengths",
    "rotation_about",
    "shift_range",
    "to_right_handed",
    "vertex_resolution",
    "xyz_to_lonlat",
]
