"""Cases that scripts/compare times in two versions, using the public interface of both."""
