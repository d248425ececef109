"""The Zillow Indoor Dataset (ZInD): panoramas of empty homes with room layouts and camera poses."""
