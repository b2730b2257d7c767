"""Cases that scripts/compare times in two versions; they use the public interface of either."""
