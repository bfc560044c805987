"""Each jaw unrolled: its grid, where crowns and gum stand in it, what each photograph shows."""
