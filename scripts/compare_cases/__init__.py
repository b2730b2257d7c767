"""Parts of scripts/compare, which runs the same cases in two versions."""
