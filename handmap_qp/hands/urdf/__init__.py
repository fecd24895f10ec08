"""What is done to URDF text: reading, checking, composing, mirroring."""
