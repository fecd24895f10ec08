"""Any hand: its description, its Pinocchio model, the hands that come with the package."""
