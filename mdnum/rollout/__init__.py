"""Running: epochs of a Verlet list, what they record, and the folder it goes into."""
