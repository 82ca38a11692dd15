"""Features, matches and retrieval between keyframes."""
