"""The drawings of the documentation; ``python -m docs.drawings.cells OUT.png`` makes one."""
