"""A score that anybody can repeat: every mapping and peer on public gestures, on several hands."""
