"""Ground and flights that brmgeo makes itself: the demo region, towns of tests and of training, simulated flights."""
