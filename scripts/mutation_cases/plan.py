"""Plan of the tests that must kill the mutants of each kernel file.

Quick tests come first, because the first failure ends a trial.
"""

SCHEMAS, BUILDER, SERVER = "tests/unit/schemas/", "tests/unit/builder/", "tests/unit/server/"
WALK = (SERVER + "simulation/world/test_frame_walk.py",)


def work(*questions: str) -> tuple[str, ...]:
    """Return the tests that the answers and the work of these queries are unchanged."""
    test = SERVER + "queries/test_work.py::test_answers_and_work_are_what_they_were"
    return tuple(
        f"{test}[{question}-{kind}]"
        for kind in ("fine", "classed", "flat", "broken")
        for question in questions
    )


def tangent(question: str) -> tuple[str, ...]:
    """Return the tests that contact begins at the unit of the definition."""
    test = SERVER + "queries/test_tangent.py::test_contact_begins_at_the_unit_of_the_definition"
    return tuple(f"{test}[{question}-{name}]" for name in ("small-fine", "deep-flat"))


# Sweeps that graze, begin or end in contact, and meet unknown regions.
SWEEPS = tuple(
    f"tests/hard_cases/test_sweep.py::test_case_{name}"
    for name in (
        "26_contact_at_the_very_end_and_at_the_very_beginning",
        "26_ways_from_a_centimetre_to_ten_kilometres",
        "26_contact_beyond_a_graze_is_found",
        "26_zero_motion_is_the_static_answer",
        "26_a_graze_is_unknown_or_found_never_clear",
        "30_a_tolerance_widens_the_interval_and_no_more",
        "21_what_is_missing_is_unknown_from_there_on",
        "21_regions_of_scans_left_out",
    )
)

# The tests of prefetched voxels that take less than two seconds.
AHEAD = tuple(
    SERVER + f"kernels/prediction/test_track_prediction.py::test_{name}"
    for name in (
        "straight_and_even_is_seen_as_such",
        "acceleration_is_seen",
        "few_poses_and_equal_times_say_little",
        "what_is_older_than_the_history_says_nothing",
        "jitter_of_clock_and_place_moves_a_prediction_little",
        "turning_is_followed",
        "no_way_is_longer_than_people_go",
        "of_no_time_ahead_the_user_stands",
        "distance_to_ways_is_the_least_of_all",
        "a_ball_that_passes_by_touches_where_it_is_nearest",
        "of_more_than_there_is_room_for_the_first_pieces_come_first",
        "far_outside_the_scene_nothing_is_wanted",
        "what_balls_touch_is_what_brute_force_finds",
        "what_is_wanted_is_what_brute_force_finds[2-20-15-0.0]",
        "what_is_wanted_is_what_brute_force_finds[2-20-15-60.0]",
        "what_is_wanted_is_what_brute_force_finds[3-300-0-60.0]",
        "what_is_wanted_is_what_brute_force_finds[6-700-40-60.0]",
    )
)

# The tests of normals that call kernels, without the slowest.
NORMALS = tuple(
    SERVER + f"queries/test_surface_normals.py::test_{name}"
    for name in (
        "what_is_stored_is_what_is_found_at_first_use",
        "where_no_point_is_there_is_no_normal",
        "what_is_looked_into_is_what_it_was",
        "normals_are_those_of_numpy",
        "of_an_evicted_voxel_nothing_is_kept_and_the_same_is_found",
        "what_is_kept_is_bounded_and_the_oldest_goes_first",
        "warming_loads_nothing_and_leaves_nothing_to_compile",
        "codes_are_the_same_in_any_order_and_whatever_else_is_resident",
    )
)

TESTS: dict[str, tuple[str, ...]] = {
    "schemas/kernels/morton.py": (SCHEMAS + "kernels/test_morton.py",),
    "schemas/kernels/normal_codes.py": (SCHEMAS + "kernels/test_normal_codes.py",),
    "schemas/kernels/record_rows.py": (SCHEMAS + "kernels/test_record_rows.py",),
    "builder/kernels/trees/bounding_sphere.py": (
        BUILDER + "kernels/trees/test_bounding_sphere.py::test_a_bound_is_as_tight_as_its_guess",
        BUILDER
        + "kernels/trees/test_bounding_sphere.py::test_a_guess_whose_radius_does_not_fit_is_given_up_for_the_box",
        BUILDER + "kernels/trees/test_bounding_sphere.py::test_what_stood_in_the_arrays_before_is_not_read",
        BUILDER + "kernels/trees/test_bounding_sphere.py::test_ceil_sqrt_is_exact",
        BUILDER + "kernels/trees/test_bounding_sphere.py::test_degenerate_sets_are_bounded",
        BUILDER + "kernels/trees/test_bounding_sphere.py::test_a_flat_set_has_a_thin_slab",
        BUILDER + "kernels/trees/test_bounding_sphere.py::test_bounds_of_scans_enclose",
        BUILDER + "kernels/trees/test_bounding_sphere.py::test_spreads_of_parts_join_to_that_of_all",
        BUILDER
        + "kernels/trees/test_bounding_sphere.py::test_the_direction_of_least_variance_is_an_eigenvector",
        BUILDER
        + "kernels/trees/test_bounding_sphere.py::test_a_direction_is_found_at_once_where_one_variance_is_the_least",
    ),
    "builder/kernels/neighbours/filter_counts.py": (BUILDER + "kernels/neighbours/test_filter_counts.py",),
    "builder/kernels/neighbours/point_classes.py": (
        BUILDER + "kernels/neighbours/test_point_classes.py",
        BUILDER
        + "passes/test_radius_classes.py::test_the_kernel_and_the_judge_agree_at_the_edge_of_each_rule",
        BUILDER
        + "passes/test_radius_classes.py::test_the_twelfth_neighbour_decides_and_at_the_limit_is_within",
        BUILDER + "passes/test_radius_classes.py::test_a_mean_at_the_limit_is_no_rim",
    ),
    "builder/kernels/neighbours/nearest_neighbours.py": (
        BUILDER
        + "kernels/neighbours/test_nearest_neighbours.py::test_what_is_inserted_is_among_the_first_in_order",
        BUILDER
        + "kernels/neighbours/test_nearest_neighbours.py::test_the_distance_of_a_box_is_that_of_its_nearest_place",
        BUILDER + "kernels/neighbours/test_nearest_neighbours.py::test_the_closest_equal_brute_force",
        BUILDER + "kernels/neighbours/test_nearest_neighbours.py::test_ties_go_to_lesser_coordinates",
        BUILDER + "kernels/neighbours/test_nearest_neighbours.py::test_a_distance_at_the_limit_counts",
        BUILDER + "kernels/neighbours/test_nearest_neighbours.py::test_boxes_hold_their_points",
        BUILDER + "kernels/neighbours/test_nearest_neighbours.py::test_the_order_of_points_changes_nothing",
    ),
    "builder/kernels/points/content_hash.py": (BUILDER + "kernels/points/test_content_hash.py",),
    "builder/kernels/neighbours/nearest_points.py": (BUILDER + "kernels/neighbours/test_nearest_points.py",),
    "builder/kernels/points/representatives.py": (BUILDER + "passes/test_level_pass.py",),
    "builder/kernels/points/voxel_records.py": (BUILDER + "kernels/points/test_voxel_records.py",),
    "builder/kernels/points/occupied_cubes.py": (BUILDER + "kernels/points/test_occupied_cubes.py",),
    "builder/kernels/points/cube_components.py": (BUILDER + "kernels/points/test_cube_components.py",),
    "builder/kernels/points/lzf_decoder.py": (BUILDER + "kernels/points/test_lzf_decoder.py",),
    "builder/kernels/neighbours/estimate_normals.py": (
        BUILDER + "voxel/test_point_normals.py::test_codes_are_those_of_the_definition",
        BUILDER + "voxel/test_point_normals.py::test_sums_at_the_bound_are_exact",
        BUILDER
        + "voxel/test_point_normals.py"
        + "::test_sums_of_boxes_are_those_of_their_points_and_of_those_that_fit_no_reach_zeros",
        BUILDER
        + "voxel/test_point_normals.py::test_order_changes_nothing_and_a_heap_costs_what_a_point_does",
    ),
    "builder/kernels/points/octree_cells.py": (
        BUILDER
        + "kernels/points/test_octree_cells.py::test_the_first_that_is_not_below_is_found_in_every_part",
        BUILDER + "kernels/points/test_octree_cells.py::test_a_cells_axes_stand_side_by_side",
        BUILDER + "kernels/points/test_octree_cells.py::test_cells_are_runs_of_the_sorted_codes",
        BUILDER + "kernels/points/test_octree_cells.py::test_a_cell_is_split_only_when_it_must_be",
        BUILDER + "kernels/points/test_octree_cells.py::test_a_cell_may_be_full",
        BUILDER + "kernels/points/test_octree_cells.py::test_points_on_cell_borders_are_in_one_cell",
        BUILDER + "kernels/points/test_octree_cells.py::test_sorted_runs_are_merged_stably",
    ),
    "builder/kernels/trees/pack_tree.py": (BUILDER + "kernels/trees/test_pack_tree.py",),
    "builder/kernels/points/spool_rows.py": (BUILDER + "kernels/points/test_spool_rows.py",),
    "builder/kernels/trees/build_tree.py": (
        BUILDER + "kernels/trees/test_build_tree.py",
        BUILDER + "voxel/test_top_hierarchy.py",
    ),
    "server/kernels/core/voxels_in_reach.py": (
        SERVER + "kernels/core/test_pose_checks.py",
        SERVER + "kernels/core/test_placed_points.py",
        SERVER + "kernels/core/test_voxels_in_reach_rows.py",
        SERVER + "kernels/core/test_voxels_in_reach.py::test_find_key_finds_what_is_there_and_nothing_else",
    ),
    "server/kernels/bodies/body_pairs.py": (
        SERVER + "kernels/bodies/test_body_pairs.py",
        SERVER + "kernels/bodies/test_body_sweep.py",
    ),
    "server/kernels/motion/screw_motion.py": (SERVER + "kernels/motion/test_screw_motion.py", *work("sweep")),
    "server/kernels/prediction/track_prediction.py": AHEAD,
    "server/kernels/motion/sweep_advance.py": (*work("sweep", "sweep bounded"), *SWEEPS),
    "server/kernels/motion/sweep_segments.py": (*work("sweep", "sweep bounded"), *SWEEPS),
    "server/kernels/core/separation_order.py": (
        SERVER + "kernels/core/test_separation_order.py",
        *work("distance"),
    ),
    "server/kernels/nearest/nearest_pair.py": work(
        "distance", "distance deep", "distance within", "distance bounded"
    ),
    "server/kernels/collide/coarse_clearance.py": (
        SERVER + "residency/test_coarse_bounds.py::test_the_nodes_of_a_top_enclose_all_points",
        SERVER + "residency/test_coarse_bounds.py::test_filled_and_remembered_are_the_same_rows",
        SERVER + "residency/test_coarse_bounds.py::test_no_point_has_a_larger_sphere_than_its_node_says",
        SERVER + "kernels/collide/test_coarse_clearance.py",
    ),
    "server/kernels/contacts/contact_cells.py": (
        SERVER + "kernels/contacts/test_cell_hash.py",
        *work("contacts", "contacts deep"),
        *tangent("contacts"),
    ),
    "server/kernels/contacts/contact_pairs.py": (*work("contacts", "contacts deep"), *tangent("contacts")),
    "server/kernels/core/node_overlap.py": (
        SERVER + "kernels/core/test_placed_avatar.py",
        *tangent("collide"),
        *work("collide", "distance"),
    ),
    "server/kernels/nearest/block_distances.py": work("distance", "distance deep", "bounded deep"),
    "server/kernels/core/scene_arrays.py": (
        SERVER + "kernels/core/test_outward.py",
        SERVER + "kernels/core/test_scene_arrays.py",
        *work("collide", "contacts"),
    ),
    "server/kernels/motion/contact_times.py": (*work("sweep", "sweep bounded"), *SWEEPS),
    "server/kernels/motion/moving_avatar.py": (
        SERVER + "kernels/motion/test_moving_avatar.py",
        *work("sweep", "sweep bounded"),
    ),
    "server/kernels/nearest/nearest_by_scan.py": (SERVER + "queries/test_distance_per_scan.py",),
    "server/kernels/nearest/nearest_search.py": work("distance", "distance deep", "distance within"),
    "server/kernels/nearest/nearest_resident.py": (
        SERVER + "queries/test_distance_fast.py",
        "tests/property/test_distance_fast_naive.py::test_one_pose_has_the_bits_of_distance",
    ),
    "server/kernels/bodies/body_sweep.py": (SERVER + "kernels/bodies/test_body_sweep.py",),
    "server/kernels/bodies/moving_bodies.py": (SERVER + "kernels/bodies/test_body_sweep.py",),
    "server/kernels/rays/stored_normals.py": NORMALS,
    "server/kernels/collide/collide_poses.py": (
        *work("collide", "collide deep", "collide one", "collide within"),
        *tangent("collide"),
    ),
    "server/kernels/nearest/missing_voxels.py": (SERVER + "kernels/nearest/test_missing_voxels.py",),
    "server/kernels/collide/early_contact.py": work("collide within"),
    "server/kernels/collide/leaf_contact.py": (
        *work("collide", "collide deep", "collide within"),
        *tangent("collide"),
    ),
    "server/kernels/core/placed_avatar.py": (
        SERVER + "kernels/core/test_placed_avatar.py",
        SERVER + "kernels/core/test_placed_points.py",
        *tangent("collide"),
        *work("collide"),
    ),
    "server/kernels/nearest/best_first_search.py": (
        *work("bounded deep", "collide bounded", "distance bounded"),
        *tangent("bounded"),
    ),
    "server/kernels/nearest/pair_heap.py": work("bounded deep", "collide bounded", "distance bounded"),
    "server/kernels/motion/sweep_resident.py": (SERVER + "queries/test_resident_fast_path.py",),
    "server/kernels/walk/walk_state.py": WALK,
    "server/kernels/walk/walk_vectors.py": WALK,
    "server/kernels/walk/walk_obstacles.py": (SERVER + "simulation/world/test_walk_bodies.py",),
    "server/kernels/walk/walk_bodies.py": (SERVER + "simulation/world/test_walk_bodies.py",),
    "server/kernels/walk/walk_queries.py": (*WALK, SERVER + "simulation/world/test_motion_end.py"),
    "server/kernels/walk/walk_normals.py": (*WALK, SERVER + "simulation/world/test_contact_normal.py"),
    "server/kernels/walk/walk_motions.py": (*WALK, SERVER + "simulation/world/test_motion_end.py"),
    "server/kernels/walk/walk_frame.py": WALK,
    "server/kernels/walk/contact_normal.py": (SERVER + "simulation/world/test_contact_normal.py",),
    "server/kernels/walk/slide_planes.py": (SERVER + "simulation/effects/test_slide_effect.py",),
    "server/kernels/walk/slide_along.py": (*WALK, SERVER + "simulation/effects/test_slide_effect.py"),
    "server/kernels/walk/ground_plane.py": (*WALK, SERVER + "simulation/effects/test_ground_effect.py"),
    "server/kernels/walk/ground_search.py": (*WALK, SERVER + "simulation/effects/test_ground_effect.py"),
    "server/kernels/walk/stand_on_ground.py": (*WALK, SERVER + "simulation/effects/test_ground_effect.py"),
    "server/kernels/walk/step_up.py": (*WALK, SERVER + "simulation/effects/test_ground_effect.py"),
    "server/kernels/rays/nearest_in_memory.py": (SERVER + "kernels/rays/test_nearest_in_memory.py",),
    "server/kernels/motion/motion_end.py": (SERVER + "simulation/world/test_motion_end.py",),
    "server/kernels/rays/rays.py": work("raycast", "raycast bounded"),
    "server/kernels/rays/level_rays.py": ("tests/property/test_ray_tolerances_naive.py",),
    "server/kernels/core/node_boxes.py": (
        "tests/hard_cases/test_bounds.py",
        SERVER + "kernels/core/test_scene_arrays.py",
        *work("collide", "distance", "raycast"),
    ),
    "server/kernels/bodies/avatar_patch.py": (SERVER + "kernels/bodies/test_avatar_patch.py",),
    "server/kernels/motion/sweep_interval.py": work("sweep", "sweep bounded"),
    "server/kernels/core/voxel_tree.py": (SERVER + "kernels/core/test_voxel_tree.py",),
    "server/kernels/prediction/user_tracks.py": (SERVER + "residency/test_motion_prediction.py",),
    "server/kernels/rays/within_point.py": (
        *work("within", "within bounded"),
        SERVER + "queries/test_within_exact.py",
    ),
    "server/kernels/contacts/contact_clusters.py": (
        SERVER + "kernels/contacts/test_contact_clusters.py",
        SERVER + "kernels/contacts/test_cell_hash.py",
        *work("contacts"),
    ),
}
# Targets of files of which fewer than mutation_report.GOAL are killed; server/MUTATION.md gives the
# reason.
LOWER_GOALS = {
    "server/kernels/nearest/nearest_by_scan.py": 0.75,
    "server/kernels/nearest/nearest_resident.py": 0.65,
    "server/kernels/motion/sweep_resident.py": 0.7,
}
# Files without a mutant, with the reason.
NONE = {
    "schemas/kernels/compiling.py": "no kernel: how kernels are compiled",
    "schemas/kernels/compile_progress.py": "no kernel: messages about compilation",
    "schemas/kernels/kernel_dispatcher.py": "no kernel: for which uses kernels are compiled",
    "schemas/kernels/kernel_files.py": "no kernel: how compiled kernels are kept",
    "schemas/kernels/kernel_sources.py": "no kernel: what compiled kernels depend on",
    "server/kernels/core/array_references.py": "no kernel: how arrays are handed to kernels",
    "server/kernels/motion/motion_scratch.py": "no kernel: memory that kernels write first",
    "server/kernels/core/kernel_decorators.py": (
        "options of the compiler only, which an interpreted kernel does not see"
    ),
}
