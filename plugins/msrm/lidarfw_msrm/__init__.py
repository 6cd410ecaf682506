"""MSRM: multi-stage proposal refinement on a residual sparse backbone, with confidence-weighted box voting."""
