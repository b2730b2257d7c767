"""What was tried where a goal is not reached, or how its figure is to be read: shown beside it, by the goal's key."""

NOTES: dict[str, str] = {
    # "collide table": "",
    # "collide capt": "",
    # "collide far": "",
    # "collide contact": "",
    # "session": "",
    # "session stretch": "",
    # "distance collide": "",
    # "distance rate": "",
    # "path": "",
    # "path zenoh": "",
    # "resident": "",
    # "decode": "",
    # "growth": "",
}
