"""Stanford2D3DS: panoramas, photos and pairs of panoramas."""
