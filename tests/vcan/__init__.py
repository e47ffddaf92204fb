"""Tests on the kernel's CAN, and the guest kernel that has it where the host's has not."""
