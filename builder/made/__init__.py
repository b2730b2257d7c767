"""Generated test scenes with known ground truth: meshes, simulated scans, and reference figures."""
