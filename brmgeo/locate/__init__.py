"""The product: maps, a camera and a stream of readings in, positions out."""
