"""Prediction of the voxels that users will need.

May import server.kernels.core, schemas.
Begin with user_tracks.py.
"""
