"""What a GPU would do, seen without one."""
