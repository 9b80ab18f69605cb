"""The kernels, one folder a backend; twins have one name and give the same answers."""
