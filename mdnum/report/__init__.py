"""Report elements shared by all commands of mdnum: findings, sections, figures and pages."""
