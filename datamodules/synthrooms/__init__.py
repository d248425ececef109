"""SynthRooms: furnished rooms, ray-cast and written in Stanford2D3DS's own on-disk format."""
