"""Train and evaluate ordinary networks on 360° panoramas through tangent images."""
