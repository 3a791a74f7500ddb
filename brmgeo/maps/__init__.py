"""Footprints to building mask to ratio maps: rasterising by the pixel-centre rule, and the counting kernel."""
