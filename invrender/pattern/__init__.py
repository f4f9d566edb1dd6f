"""The light pattern: the default one, the page that shows it, the printed guide, its design."""
