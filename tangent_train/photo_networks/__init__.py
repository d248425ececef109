"""Import photo networks from other libraries and files, as checkpoints for all commands."""

from tangent_train.photo_networks.importing import import_network
from tangent_train.photo_networks.network import PhotoNetwork

__all__ = ["PhotoNetwork", "import_network"]
