"""Moving-object segmentation on range images: DPDC network, Bayes filter, edge-aware loss."""
