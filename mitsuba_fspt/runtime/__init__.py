"""Services without physics: errors, numbers, files, interrupts, Dr.Jit's backend and its LLVM library."""
