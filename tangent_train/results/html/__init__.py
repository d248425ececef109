"""Write a self-contained HTML file with tables and a viewer of panoramas."""

from tangent_train.results.html.page import EncodedImage, encode_image, write_report

__all__ = ["EncodedImage", "encode_image", "write_report"]
