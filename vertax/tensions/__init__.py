"""Tensions, pressures and their standard deviations from segmentation masks, and from moving edges."""

from vertax.tensions._edge_motion import EdgeMotion as EdgeMotion
from vertax.tensions._find_masks import MaskFrame as MaskFrame, find_masks as find_masks
from vertax.tensions._infer_tensions import infer_tensions as infer_tensions
from vertax.tensions._inferred import (
    CurvedGeometry as CurvedGeometry,
    InferredTensions as InferredTensions,
    MotionFit as MotionFit,
)
from vertax.tensions._mask import read_mask as read_mask
from vertax.tensions._mean_stress import MeanStress as MeanStress
from vertax.tensions._tensions_of_masks import (
    TensionsOfMasks as TensionsOfMasks,
    infer_tensions_of_masks as infer_tensions_of_masks,
)
