"""Results as JSON, CSV, Markdown, tables for the terminal, charts and pages."""
