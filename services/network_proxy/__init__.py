"""Network proxy: impairs the links between real processes on purpose."""
