"""Only the name by which models that 0.1.0 saved find their features extractor."""

from sb3_ctco.torch_layers import SpatialSoftmaxExtractor

__all__ = ["SpatialSoftmaxExtractor"]
