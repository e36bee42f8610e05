"""What the process needs before any physics: errors, numbers, files, interrupts, Dr.Jit's backend and its LLVM."""
