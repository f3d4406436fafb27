"""The page of the λ dial, on NiceGUI (extra ``lab``)."""
