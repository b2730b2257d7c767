"""Tour of the viewer: the pages that are driven, the scenes of the tour, and the strip of them."""
