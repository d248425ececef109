"""One self-contained HTML file with tables, curves and a viewer of panoramas; no network needed."""

from tangent_train.results.html.images import EncodedImage, ViewerImage, encode_image
from tangent_train.results.html.page import write_report
from tangent_train.results.html.parts import Curve, Table

__all__ = ["Curve", "EncodedImage", "Table", "ViewerImage", "encode_image", "write_report"]
