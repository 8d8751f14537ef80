"""What every verb shows: findings, sections, figures, one page."""
