"""Buildings in pictures: training tiles, the U-Net and its training, prediction, ONNX export.

torch lives in this room and is imported by the modules that train or export only; predicting runs on ONNX Runtime.
Labels and masks are uint8 everywhere in here: the LABEL codes of ``brmgeo.codes``, of which loss and metrics leave the
unknown out.
"""

SPLITS = ("train", "validation", "test")
