"""Files in: DXF sheets, other vector footprints, imagery tiles and rasters, each turned into values and back."""
