"""Output that all verbs share: findings, sections, figures, and the page."""
