"""What a gradient folder says, to people."""
