"""What is evaluated: methods, rows (a method in a setting), suites of rows, and UfM (ICRA 2022)."""
