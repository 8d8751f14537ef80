"""The verbs, a module each; their functions are those of `mdnum`."""
