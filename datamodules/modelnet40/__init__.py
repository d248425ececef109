"""ModelNet40: shapes as spheres."""
