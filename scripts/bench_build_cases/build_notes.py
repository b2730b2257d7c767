"""Notes on the targets of scripts/bench_build, shown beside them, by the target's key."""

NOTES: dict[str, str] = {
    "throughput": "from the command's start to its end: interpreter, both passes over the LAS file, SHA-256, verifying",
    "memory": "sum of PSS over the command and all its workers, looked at 20 times a second; --memory and 200 MB",
    "linear": "seconds from one size to the next over the points between them: the start of the command, about 2 s "
    "whatever the size, is in none of them",
    "bytes": "index and shards, octree and hierarchy included; the preview for ParaView, 1.2 MB at most, is not",
    "laz": "LAZ holds the points alone, in the order they were scanned: no hierarchy, and no way to find what is near",
}
