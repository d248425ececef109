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

from tangent_train.geometry.camera import camera_matrix_from_fov as camera_matrix_from_fov
from tangent_train.geometry.camera import is_camera_matrix as is_camera_matrix
from tangent_train.geometry.camera import lengths_of_rays as lengths_of_rays
from tangent_train.geometry.camera import perspective_directions as perspective_directions
from tangent_train.geometry.camera import pixel_solid_angles as pixel_solid_angles
from tangent_train.geometry.camera import ray_lengths as ray_lengths
from tangent_train.geometry.camera import shift_range as shift_range
from tangent_train.geometry.grids import CubeGrid as CubeGrid
from tangent_train.geometry.grids import PinholeGrid as PinholeGrid
from tangent_train.geometry.grids import RingGrid as RingGrid
from tangent_train.geometry.grids import TangentGrid as TangentGrid
from tangent_train.geometry.icosphere import icosphere as icosphere
from tangent_train.geometry.icosphere import vertex_resolution as vertex_resolution
from tangent_train.geometry.perspective import Angles as Angles
from tangent_train.geometry.perspective import perspective_grid as perspective_grid
from tangent_train.geometry.perspective import view_rotation as view_rotation
from tangent_train.geometry.sphere import MOST_ROWS as MOST_ROWS
from tangent_train.geometry.sphere import PanoramaPose as PanoramaPose
from tangent_train.geometry.sphere import checked_rotation as checked_rotation
from tangent_train.geometry.sphere import equirect_directions as equirect_directions
from tangent_train.geometry.sphere import equirect_elevations as equirect_elevations
from tangent_train.geometry.sphere import equirect_latitudes as equirect_latitudes
from tangent_train.geometry.sphere import equirect_longitudes as equirect_longitudes
from tangent_train.geometry.sphere import equirect_shape as equirect_shape
from tangent_train.geometry.sphere import equirect_solid_angles as equirect_solid_angles
from tangent_train.geometry.sphere import equirect_to_lonlat as equirect_to_lonlat
from tangent_train.geometry.sphere import lonlat_to_equirect as lonlat_to_equirect
from tangent_train.geometry.sphere import lonlat_to_xyz as lonlat_to_xyz
from tangent_train.geometry.sphere import nearest_level as nearest_level
from tangent_train.geometry.sphere import panorama_rows as panorama_rows
from tangent_train.geometry.sphere import random_rotation as random_rotation
from tangent_train.geometry.sphere import rotation_about as rotation_about
from tangent_train.geometry.sphere import to_right_handed as to_right_handed
from tangent_train.geometry.sphere import xyz_to_lonlat as xyz_to_lonlat
