"""Frames of walking avatars: the effects from `sweep` to `ground`, in one call.

May import server.kernels.bodies, server.kernels.collide, server.kernels.core, server.kernels.motion,
server.kernels.rays, schemas.
Begin with state.py.
"""
