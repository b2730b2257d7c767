"""Walking: one frame of the effects from `sweep` to `ground` in one call.

Room of kernels. Its files, from the bottom up: walk_vectors, walk_state, walk_queries, walk_motions,
contact_normal, slide_planes, slide_along, ground_plane, ground_search, stand_on_ground, step_up,
walk_frame.
May import: kernels of bodies, collide, core, motion, rays; schemas.
"""
