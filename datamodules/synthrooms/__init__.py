"""SynthRooms: furnished rooms, ray-cast and written in the on-disk format of Stanford2D3DS."""
