"""The rows of an evaluation: methods, rows (a method in a setting), suites of rows, and UfM (ICRA 2022)."""
