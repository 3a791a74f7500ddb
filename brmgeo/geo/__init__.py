"""Where things are: coordinate reference systems, the region lattice, NGII sheet numbers, tile grids.

The conventions that hold everywhere are written once, here:

- World coordinates are x easting, y northing, metres, float64, in the region's projected CRS
  (``always_xy=True`` in every transformation). Bounds are (left, bottom, right, top).
- Pixels are (row, col), row 0 at the top (north). Whole numbers are pixel edges, centres lie at +0.5.
  A pixel belongs to a polygon or disc when its centre does.
- A region has one lattice: pixel edges lie on whole multiples of the GSD, so crops are exact.
- Internally yaw is in radians, counter-clockwise from east; people read ``heading_deg``, clockwise from grid north.
"""
