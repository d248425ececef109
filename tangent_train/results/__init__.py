"""Results as JSON, CSV, Markdown, tables for the terminal, and pages."""
