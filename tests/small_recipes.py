"""A recipe of training that is done in seconds."""

from __future__ import annotations

TINY = """
title = "tiny"
work_gsd_m = 0.25
validation_crops = 4
[unet]
widths = [8, 16]
[training]
steps = 4
batch = 2
crop_px = 32
warmup_steps = 1
epoch_steps = 2
device = "cpu"
[augment]
gsd_m = [0.2, 0.4]
[[source]]
name = "towns"
kind = "generated"
seeds = [901]
size_m = 300
[[source]]
name = "held"
kind = "generated"
split = "validation"
seeds = [902]
size_m = 300
[[source]]
name = "far"
kind = "generated"
split = "test"
seeds = [903]
size_m = 300
[[source]]
name = "flown"
kind = "flight"
split = "test"
"""
