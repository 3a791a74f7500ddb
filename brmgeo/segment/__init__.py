"""Buildings in pictures: training tiles, the U-Net and its training, prediction, ONNX export.

torch lives in this room and is imported by the modules that train or export only; predicting runs on ONNX Runtime.
Labels and masks are uint8 everywhere in here: the LABEL codes of ``brmgeo.codes``, of which loss and metrics leave the
unknown out.
"""

import os

# ONNX Runtime keeps a device id in the user's cache folder and looks for a host to tell of every session, from its import
# on. Nothing but this, and before that import, keeps it from that.
os.environ["ORT_DISABLE_TELEMETRY"] = "1"

SPLITS = ("train", "validation", "test")
