"""Parts of scripts/compare and scripts/compare_answers, which run the same cases in two versions."""
