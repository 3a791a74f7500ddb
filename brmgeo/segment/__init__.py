"""Buildings in pictures: training tiles, the U-Net and its training, prediction, ONNX export.

torch lives in this room and is imported by the modules that train or export only; predicting runs on ONNX Runtime.
Labels and masks are uint8 everywhere in here: OTHER, BUILDING, and UNKNOWN, which loss and metrics leave out.
"""

OTHER, BUILDING, UNKNOWN = 0, 255, 127
SPLITS = ("train", "validation", "test")
