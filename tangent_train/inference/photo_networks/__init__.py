"""Networks of other libraries and files, as checkpoints that every command takes."""

from tangent_train.inference.photo_networks.importing import Imported, import_network
from tangent_train.inference.photo_networks.network import PhotoNetwork

__all__ = ["Imported", "PhotoNetwork", "import_network"]
