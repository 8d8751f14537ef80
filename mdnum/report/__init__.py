"""Output shared by all commands of mdnum: findings, sections, figures, and the page."""
