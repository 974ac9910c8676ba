# SPDX-License-Identifier: Apache-2.0
"""`paul study`: questions that are asked of the method as a whole, each answered by a table and a picture."""
