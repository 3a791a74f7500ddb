"""Buildings in pictures: training tiles, the U-Net and its training, prediction, ONNX export.

torch lives in this room and is imported by the modules that train or export only; predicting runs on ONNX Runtime.
Labels and masks are uint8 everywhere in here: the LABEL codes of ``brmgeo.codes``, of which loss and metrics leave the
unknown out.
"""

import os

# ONNX Runtime's builds for some systems keep a device id in the user's cache folder and look for a host to tell of every
# session, from their import on. Nothing but this, and before that import, keeps them from it.
os.environ.setdefault("ORT_DISABLE_TELEMETRY", "1")

SPLITS = ("train", "validation", "test")
