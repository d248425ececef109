"""Networks of other libraries and files, as checkpoints that every command takes."""

from tangent_train.inference.photo_networks.importing import import_network
from tangent_train.inference.photo_networks.network import PhotoNetwork

__all__ = ["PhotoNetwork", "import_network"]
